// The formats of files, written by `make goldens` from sceneprint_client/formats.py.

/** @typedef {"depth"|"cloud"|"map"|"archive"|"recording"} FileKind */
/** @type {{kind: FileKind, name: string, title: string, suffixes: string[], signature: string}[]} */
export const FORMATS = [
  {"kind": "cloud", "name": "ply", "title": "PLY", "suffixes": [".ply"], "signature": "ply[\\n\\r ]"},
  {"kind": "cloud", "name": "pcd", "title": "PCD", "suffixes": [".pcd"], "signature": "[\\r\\n]*(?:#[^\\n]{0,200}\\n[\\r\\n]*){0,99}(?:VERSION|FIELDS|COLUMNS)[ \\t]"},
  {"kind": "cloud", "name": "las", "title": "LAS, LAZ", "suffixes": [".las", ".laz"], "signature": "LASF"},
  {"kind": "cloud", "name": "npy", "title": "NPY", "suffixes": [".npy"], "signature": "\\x93NUMPY[\\s\\S]{4,6}(?=[^}]*'descr': *'[<>]f[248]')(?=[^}]*'shape': *\\(\\d+L?, *[34]L?,? *\\))"},
  {"kind": "cloud", "name": "kitti", "title": "KITTI .bin", "suffixes": [".bin"], "signature": ""},
  {"kind": "cloud", "name": "pointcloud2", "title": "PointCloud2 in CDR", "suffixes": [".cdr"], "signature": "\\x00[\\x00\\x01]\\x00[\\x00-\\x03](?=[\\s\\S]*?(?:\\x02\\x00\\x00\\x00|\\x00\\x00\\x00\\x02)[xX]\\x00)(?=[\\s\\S]*?(?:\\x02\\x00\\x00\\x00|\\x00\\x00\\x00\\x02)[yY]\\x00)(?=[\\s\\S]*?(?:\\x02\\x00\\x00\\x00|\\x00\\x00\\x00\\x02)[zZ]\\x00)"},
  {"kind": "depth", "name": "png", "title": "PNG", "suffixes": [".png"], "signature": "\\x89PNG\\r\\n\\x1a\\n"},
  {"kind": "depth", "name": "npy", "title": "NPY", "suffixes": [".npy"], "signature": "\\x93NUMPY(?:[^}]*'shape': *\\((?=\\d+, *(\\d+)\\))(\\d+))?"},
  {"kind": "depth", "name": "pfm", "title": "PFM", "suffixes": [".pfm"], "signature": "Pf[\\n\\r ]+(?:(\\d+) +(\\d+))?"},
  {"kind": "depth", "name": "compresseddepth", "title": "compressedDepth of ROS", "suffixes": [], "signature": "[\\s\\S]{12}\\x89PNG\\r\\n\\x1a\\n"},
  {"kind": "map", "name": "e57", "title": "E57", "suffixes": [".e57"], "signature": "ASTM-E57"},
  {"kind": "map", "name": "stl", "title": "STL", "suffixes": [".stl"], "signature": ""},
  {"kind": "map", "name": "obj", "title": "OBJ", "suffixes": [".obj"], "signature": ""},
  {"kind": "map", "name": "glb", "title": "glTF", "suffixes": [".glb"], "signature": "glTF"},
  {"kind": "map", "name": "gltf", "title": "glTF", "suffixes": [".gltf"], "signature": ""},
  {"kind": "archive", "name": "zip", "title": "zip", "suffixes": [".zip"], "signature": "PK(?:\\x03\\x04|\\x05\\x06)"},
  {"kind": "archive", "name": "tar", "title": "tar", "suffixes": [".tar"], "signature": "[\\s\\S]{257}ustar"},
  {"kind": "archive", "name": "gzip", "title": "tar.gz", "suffixes": [".gz", ".tgz"], "signature": "\\x1f\\x8b"},
  {"kind": "archive", "name": "bzip2", "title": "tar.bz2", "suffixes": [".bz2", ".tbz2"], "signature": "BZh"},
  {"kind": "archive", "name": "xz", "title": "tar.xz", "suffixes": [".xz", ".txz"], "signature": "\\xfd7zXZ\\x00"},
  {"kind": "recording", "name": "mcap", "title": "MCAP", "suffixes": [".mcap"], "signature": "\\x89MCAP0\\r\\n"},
  {"kind": "recording", "name": "rosbag2", "title": "rosbag2", "suffixes": [".db3"], "signature": "SQLite format 3\\x00"},
  {"kind": "recording", "name": "rosbag1", "title": "ROS 1", "suffixes": [".bag"], "signature": "#ROSBAG V2"},
];
