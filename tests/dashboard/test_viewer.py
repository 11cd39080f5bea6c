"""Tests of the viewer: its sums, and pixels at projected positions."""

import base64
import math

import numpy as np
import pytest

from sceneprint.formats.export import encode_points

#: Of the canvas, CSS pixels, and pixels of an angle whose tangent is 1.
WIDTH, HEIGHT = 400, 300
FOCAL = HEIGHT / 2 / math.tan(math.radians(22.5))


@pytest.fixture
def stage(page, station):
    """An empty page of the dashboard with a canvas and our modules."""
    page.goto(station.home)
    page.evaluate(
        """async () => {
          const base = `${location.pathname.replace(/\\/$/, "")}/viewer/`;
          for (const name of ["matrix", "camera", "points", "shapes", "viewer"]) {
            window[name] = await import(`${base}${name}.js`);
          }
          const canvas = document.createElement("canvas");
          canvas.style.setProperty("width", "400px");
          canvas.style.setProperty("height", "300px");
          canvas.style.setProperty("position", "fixed");
          canvas.style.setProperty("inset", "0 auto auto 0");
          canvas.style.setProperty("z-index", "9");
          document.body.append(canvas);
          window.canvas = canvas;
          window.bytes = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
          window.view = viewer.createViewer(canvas, { label: "A test" });
          view.look({ target: [0, 0, 0], distance: 2, azimuth: 0, elevation: 0 });
        }"""
    )
    return page


def cloud(page, data, **more):
    options = {"shade": 0, "size": 0.05, **more}
    page.evaluate(
        "([text, more]) => view.cloud('a', { points: points.parsePoints(bytes(text)), ...more })",
        [base64.b64encode(data).decode(), options],
    )


def drawn(page):
    """(HEIGHT, WIDTH, 3) of the canvas, as it is drawn."""
    text = page.evaluate(
        """() => { const p = view.pixels(); let text = "";
          for (let i = 0; i < p.length; i += 4096) {
            text += String.fromCharCode(...p.subarray(i, i + 4096));
          }
          return btoa(text); }"""
    )
    flat = np.frombuffer(base64.b64decode(text), np.uint8)
    return flat.reshape(HEIGHT, WIDTH, 4)[..., :3]


def seen_at(point):
    """Row and column of a point (x right, y down, z forward) seen from (0, 0, -2)."""
    x, y, z = point
    return round(HEIGHT / 2 + FOCAL * y / (z + 2)), round(WIDTH / 2 + FOCAL * x / (z + 2))


def test_the_orbit_by_value(stage):
    js = stage.evaluate
    axes = js("() => new camera.Orbit('-y').axes()")  # looking down a little
    js("() => { window.o = new camera.Orbit('z'); o.look({azimuth: 0, elevation: 0}); }")
    axis = js("() => o.axes()")
    assert axis["right"] == pytest.approx([1, 0, 0])
    assert axis["above"] == pytest.approx([0, 0, 1])
    assert axis["ahead"] == pytest.approx([0, 1, 0])
    assert axes["ahead"] == pytest.approx([0, math.sin(0.35), math.cos(0.35)])
    js("() => o.look({ azimuth: Math.PI / 2, distance: 3, target: [1, 0, 0] })")
    assert js("() => o.axes().ahead") == pytest.approx([1, 0, 0])
    assert js("() => o.eye()") == pytest.approx([-2, 0, 0])
    js("() => o.orbit(0, 9)")  # not over the top
    assert js("() => o.elevation") == pytest.approx(math.radians(89))
    # all of a box is seen, and touches the margins
    js("() => o.look({ azimuth: 0.7, elevation: 0.4 })")
    corners = [[x, y, z] for x in (0, 4) for y in (-1, 1) for z in (0, 2.5)]
    js("(corners) => o.fit(corners, 1.5)", corners)
    clip = js("() => o.projection(1.5, { low: [0, -1, 0], high: [4, 1, 2.5] })")
    ends = np.array([[*p, 1] for p in corners]) @ np.array(clip).reshape(4, 4)
    ends = ends[:, :3] / ends[:, 3:]
    assert abs(ends[:, :2]).max() == pytest.approx(0.93, abs=1e-6)
    assert abs(ends).max() <= 1  # nor cut off in depth


def test_a_plan_by_value(stage):
    """Straight down, one scale at every height: metres to pixels by hand."""
    js = stage.evaluate
    js("""() => {
      const up = new camera.Orbit({ above: [0, 0, 1], ahead: [0, 1, 0] });
      Object.assign(view.orbit, { above: up.above, ahead: up.ahead, right: up.right });
      view.look({ target: [1, 2, 0], distance: 4, azimuth: 0, elevation: 0.3, flat: true });
    }""")
    scale = FOCAL / 4  # pixels of a metre
    for point in ((1, 2, 0), (1.5, 2.25, 0), (0.25, 1, 3), (2, 2.5, -40)):
        x, y, _ = js("(p) => view.project(p)", point)
        assert x == pytest.approx(WIDTH / 2 + (point[0] - 1) * scale)
        assert y == pytest.approx(HEIGHT / 2 - (point[1] - 2) * scale)
    assert js("() => canvas.getAttribute('aria-label')").startswith("A test. Arrow keys move")
    js("() => view.look({ flat: false })")
    assert js("() => view.orbit.elevation") == pytest.approx(0.3)  # as it was


def test_cells_lie_where_they_are_projected(stage):
    """Bytes of a tile as the API sends them: places, four colours, and heights that are cut."""
    cells = np.zeros(3, np.dtype([("at", "u1", 3), ("seen", "u1"), ("last", "<u2", 2)]))
    cells["at"] = [(64, 128, 128), (191, 64, 128), (128, 200, 128)]
    cells["seen"] = [16, 32, 48]  # by 1, 3 and 7 frames
    cells["last"] = [(0, 0), (1, 600), (65535, 65535)]
    stage.evaluate(
        """(text) => view.cells("surface", {
          tiles: [{ name: "one", data: bytes(text), span: 2.56, cell: 0.05,
                    matrix: [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -1.28, -1.28, -1.285, 1] }],
          extent: { low: [-1, -1, -1], high: [1, 1, 1] },
          palette: new Uint8Array([10, 20, 30, 200, 0, 100]),
          heights: [-1, 1], most: 48, ages: [0, 600], cut: null,
        })""",
        base64.b64encode(cells.tobytes()).decode(),
    )
    at = (cells["at"] + 0.5) / 256 * 2.56 - [1.28, 1.28, 1.285]
    ramp = np.array([(0.267, 0.005, 0.329), (0.230, 0.322, 0.546), (0.128, 0.567, 0.551),
                     (0.369, 0.789, 0.383), (0.993, 0.906, 0.144)])  # fmt: skip

    def ramped(share):
        place = min(max(share, 0), 1) * 4
        k = min(int(place), 3)
        return 255 * (ramp[k] + (ramp[k + 1] - ramp[k]) * (place - k))

    shares = (1 - at[:, 1]) / 2  # up is -y here
    grey = np.array([150, 155, 160.0])
    sessions = [np.array([10, 20, 30.0]), np.array([200, 0, 100.0]), grey]
    for colour, wanted in (
        ("height", [ramped(x) for x in shares]),
        ("session", [c * (0.6 + 0.4 * x) for c, x in zip(sessions, shares, strict=True)]),
        ("seen", [ramped(0), ramped(0.5), ramped(1)]),
        ("age", [ramped(0), ramped(1), grey]),
    ):
        stage.evaluate("(colour) => view.cells('surface', { colour })", colour)
        picture = drawn(stage).astype(float)
        for point, own in zip(at, wanted, strict=True):
            assert abs(picture[seen_at(point)] - own).max() <= 1.5, (colour, point)


def test_points_are_read_as_they_were_written(stage):
    rng = np.random.default_rng(2)
    at = rng.uniform(-3, 5, (50, 3))
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    residuals = rng.integers(0, 256, 50).astype(np.uint8)
    data = encode_points(at, normals, np.arange(-1, 49), residuals, total=99, scale=0.12)
    text = base64.b64encode(data).decode()
    result = stage.evaluate(
        """(text) => { const p = points.parsePoints(bytes(text));
          return [p.count, p.total, p.scale, p.hasNormals && p.hasPatches && p.hasResiduals,
            [...Array(p.count).keys()].map((i) => points.pointAt(p, i)),
            [...points.residualCounts(p)]]; }""",
        text,
    )
    assert result[:2] == [50, 99]
    assert result[2] == pytest.approx(0.12)
    assert result[3] is True
    assert np.array([p["position"] for p in result[4]]) == pytest.approx(at, abs=2e-4)
    assert np.array([p["normal"] for p in result[4]]) == pytest.approx(normals, abs=0.005)
    assert [p["patch"] for p in result[4]] == [65535, *range(49)]
    assert [p["residual"] for p in result[4]] == residuals.tolist()
    assert result[5] == np.bincount(residuals, minlength=256).tolist()


def test_the_nearer_hides_the_farther_and_none_is_too_small(stage):
    far, near = (0.0, 0.0, 3.0), (0.0, 0.0, 0.0)
    ground = drawn(stage)[0, 0].tolist()
    cloud(stage, encode_points(np.array([near])), tint=[0, 0, 255])
    text = base64.b64encode(encode_points(np.array([far, (1.0, 0.5, 3.0)]))).decode()
    stage.evaluate(
        "(text) => view.cloud('b', { points: points.parsePoints(bytes(text)), size: 1e-5, shade: 0,"
        " tint: [255, 0, 0] })",
        text,
    )
    picture = drawn(stage).astype(int)
    assert picture[seen_at(near)].tolist() == [0, 0, 255]
    row, column = seen_at((1.0, 0.5, 3.0))
    spot = picture[row - 3 : row + 4, column - 3 : column + 4]
    shown = abs(spot - ground).max(axis=2) > 60
    assert 1 <= shown.sum() <= 9
    stage.evaluate("view.cloud('a', { size: 5 })")  # of a metre's width no blot is made
    wide = (drawn(stage)[HEIGHT // 2] == (0, 0, 255)).all(axis=1)
    assert 13 <= wide.sum() <= 15
