// Shapes made of segments: what `viewer.lines` takes as positions.

/**
 * The camera that saw a frame, at the origin of its own axes.
 * @param {{width: number, height: number, fx: number, fy: number, cx: number, cy: number} | null}
 *   camera intrinsics of a depth camera (x right, y down, z forward); null of a cloud's sensor, whose
 *   z is up: a ring about its viewpoint, with a tick along x
 * @param {number} size metres: how far ahead the frustum ends, or the radius of the ring
 * @returns {Float32Array} six numbers a segment
 */
export function frustum(camera, size = 0.3) {
  if (!camera || !(camera.fx > 0)) return ring(size);
  const { width, height, fx, fy, cx, cy } = camera;
  const at = (u, v) => [((u - cx) / fx) * size, ((v - cy) / fy) * size, size];
  const corners = [at(-0.5, -0.5), at(width - 0.5, -0.5), at(width - 0.5, height - 0.5),
    at(-0.5, height - 0.5)];
  const [left, right] = corners;
  const middle = (left[0] + right[0]) / 2, lift = (right[0] - left[0]) / 5;
  const peak = [middle, left[1] - lift, size]; // above the upper edge: which way is up
  const out = [];
  corners.forEach((corner, k) => {
    out.push(0, 0, 0, ...corner, ...corner, ...corners[(k + 1) % 4]);
  });
  out.push(middle - lift, left[1], size, ...peak, ...peak, middle + lift, left[1], size);
  return new Float32Array(out);
}

function ring(radius, parts = 32) {
  const out = [0, 0, 0, radius * 1.5, 0, 0, 0, 0, -radius / 4, 0, 0, radius / 2];
  const at = (k) => {
    const angle = (2 * Math.PI * k) / parts;
    return [radius * Math.cos(angle), radius * Math.sin(angle), 0];
  };
  for (let k = 0; k < parts; k += 1) out.push(...at(k), ...at(k + 1));
  return new Float32Array(out);
}

/** Crosses along the three axes. @param {number[][]} points @param {number} size metres from tip to tip */
export function crosses(points, size) {
  const out = new Float32Array(18 * points.length), half = size / 2;
  points.forEach((p, i) => {
    for (let k = 0; k < 3; k += 1) {
      for (const [end, sign] of [[0, -1], [3, 1]]) {
        out.set(p, 18 * i + 6 * k + end);
        out[18 * i + 6 * k + end + k] += sign * half;
      }
    }
  });
  return out;
}

/** A segment from each point to its partner. @param {number[][]} from @param {number[][]} to */
export function links(from, to) {
  const out = new Float32Array(6 * from.length);
  from.forEach((p, i) => { out.set(p, 6 * i); out.set(to[i], 6 * i + 3); });
  return out;
}
