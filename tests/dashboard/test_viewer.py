"""Tests of the viewer: its sums, and pixels at projected positions."""

from __future__ import annotations

import base64
import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from sceneprint.formats.export import encode_points
from sceneprint.geometry.validation.inspection import STEP_COLOURS

if TYPE_CHECKING:
    from playwright.sync_api import Page

#: Of the canvas, CSS pixels, and pixels of an angle whose tangent is 1.
WIDTH, HEIGHT = 400, 300
FOCAL = HEIGHT / 2 / math.tan(math.radians(22.5))
ORANGE = (217, 119, 43)


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


def cloud(page: Page, data: bytes, **more: object) -> None:
    told = {"shade": 0, "size": 0.05, **more}
    page.evaluate(
        "([text, told]) => view.cloud('a', { points: points.parsePoints(bytes(text)), ...told })",
        [base64.b64encode(data).decode(), told],
    )


def drawn(page: Page) -> np.ndarray[Any, Any]:
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


def seen_at(point: tuple[float, float, float]) -> tuple[int, int]:
    """Row and column of a point (x right, y down, z forward) seen from (0, 0, -2)."""
    x, y, z = point
    return round(HEIGHT / 2 + FOCAL * y / (z + 2)), round(WIDTH / 2 + FOCAL * x / (z + 2))


def test_sums_by_value(stage):
    js: Callable[..., Any] = stage.evaluate
    rows = [[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    told = js("(rows) => matrix.ofRows(rows)", rows)
    assert told == np.array(rows).T.ravel().tolist()
    assert js("(m) => matrix.transformed(m, [1, 0, 0])", told) == [1, 3, 3, 1]
    back = js("(m) => matrix.multiply(matrix.inverseRigid(m), m)", told)
    assert back == pytest.approx(np.eye(4).ravel().tolist())
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 4, 4))
    product = js("([a, b]) => matrix.multiply(a, b)", [a.T.ravel().tolist(), b.T.ravel().tolist()])
    assert product == pytest.approx((a @ b).T.ravel().tolist())
    quaternion = js("(m) => matrix.quaternionOf(m)", told)
    assert quaternion == pytest.approx([0, 0, math.sqrt(0.5), math.sqrt(0.5)])
    half = js("(m) => matrix.between(matrix.identity(), m, 0.5)", told)
    assert js("(m) => matrix.transformed(m, [1, 0, 0])", half) == pytest.approx(
        [math.sqrt(0.5) + 0.5, math.sqrt(0.5) + 1, 1.5, 1]
    )
    for axis in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8]):  # half a turn, any axis
        x, y, z = axis
        matrix = js("([q, t]) => matrix.ofQuaternion(q, t)", [[x, y, z, 0], [1, 2, 3]])
        again = js("(m) => matrix.ofQuaternion(matrix.quaternionOf(m), [1, 2, 3])", matrix)
        assert again == pytest.approx(matrix)
        fixed = js("([m, p]) => matrix.transformed(m, p)", [matrix, axis])
        assert fixed == pytest.approx([x + 1, y + 2, z + 3, 1])


def test_the_orbit_by_value(stage):
    js: Callable[..., Any] = stage.evaluate
    axes = js("() => new camera.Orbit('-y').axes()")  # looking down a little
    js("() => { window.o = new camera.Orbit('z'); o.look({azimuth: 0, elevation: 0}); }")
    told = js("() => o.axes()")
    assert told["right"] == pytest.approx([1, 0, 0])
    assert told["above"] == pytest.approx([0, 0, 1])
    assert told["ahead"] == pytest.approx([0, 1, 0])
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
    js: Callable[..., Any] = stage.evaluate
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
    corners = [[x, y, z] for x in (0, 6) for y in (1, 3) for z in (0, 9)]
    js("(corners) => view.orbit.fit(corners, 4 / 3)", corners)
    assert js("() => view.orbit.target.slice(0, 2)") == pytest.approx([3, 2])
    # 6 m fill 93 % of the width
    assert 2 * math.tan(math.radians(22.5)) * js("() => view.orbit.distance") * (
        4 / 3
    ) * 0.93 == pytest.approx(6)
    clip = js("() => view.orbit.projection(4 / 3, { low: [0, 1, 0], high: [6, 3, 9] })")
    ends = np.array([[*p, 1] for p in corners]) @ np.array(clip).reshape(4, 4)
    assert abs(ends[:, :3] / ends[:, 3:]).max() <= 1  # nor cut off in depth
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

    def ramped(share: float) -> Any:
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
    # only what is between two heights: the second lies at 0.63 m, the others at -0.01 m and -0.73 m
    stage.evaluate("() => view.cells('surface', { cut: [-0.5, 0.5] })")
    picture = drawn(stage)
    blank = picture[0, 0].tolist()
    assert [picture[seen_at(point)].tolist() == blank for point in at] == [False, True, True]


def test_points_are_read_as_they_were_written(stage):
    rng = np.random.default_rng(2)
    at = rng.uniform(-3, 5, (50, 3))
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    residuals = rng.integers(0, 256, 50).astype(np.uint8)
    data = encode_points(at, normals, np.arange(-1, 49), residuals, total=99, scale=0.12)
    text = base64.b64encode(data).decode()
    told = stage.evaluate(
        """(text) => { const p = points.parsePoints(bytes(text));
          return [p.count, p.total, p.scale, p.hasNormals && p.hasPatches && p.hasResiduals,
            [...Array(p.count).keys()].map((i) => points.pointAt(p, i)),
            [...points.residualCounts(p)]]; }""",
        text,
    )
    assert told[:2] == [50, 99]
    assert told[2] == pytest.approx(0.12)
    assert told[3] is True
    assert np.array([p["position"] for p in told[4]]) == pytest.approx(at, abs=2e-4)
    assert np.array([p["normal"] for p in told[4]]) == pytest.approx(normals, abs=0.005)
    assert [p["patch"] for p in told[4]] == [65535, *range(49)]
    assert [p["residual"] for p in told[4]] == residuals.tolist()
    assert told[5] == np.bincount(residuals, minlength=256).tolist()
    why = (
        """(text) => { try { points.parsePoints(bytes(text)); } catch (e) { return e.message; } }"""
    )
    for wrong, said in (
        (data[:-1], "incomplete"), (b"ply" + data[3:], "not point data"),
        (data[:20], "not point data"),
        (data[:4] + b"\2" + data[5:], "version 2"),
    ):  # fmt: skip
        assert said in stage.evaluate(why, base64.b64encode(wrong).decode())


@pytest.mark.thorough
def test_points_lie_where_they_are_projected(stage):
    at = [(0.0, 0.0, 0.0), (0.5, 0.25, 0.0), (-0.6, -0.3, 0.5), (0.9, 0.0, 1.5)]
    normals = np.array([(0, 0, -1), (1, 0, 0), (0, -1, 0), (0.6, 0, -0.8)], float)
    residuals = np.array([30, 100, 254, 253], np.uint8)
    data = encode_points(np.array(at), normals, np.array([0, 1, 2, -1]), residuals)
    blank = drawn(stage)
    ground = blank[0, 0].tolist()
    assert (blank == blank[0, 0]).all()
    steps = [STEP_COLOURS[k].tolist() for k in (0, 1, 4, 3)]
    turned = np.rint(127.5 * (1 + normals)).tolist()
    own = [[10, 20, 30], [200, 0, 100], [0, 250, 0]]
    for told, colours in (
        ({"colour": "tint", "tint": ORANGE}, [list(ORANGE)] * 4),
        ({"colour": "residual"}, steps),
        ({"colour": "normal"}, turned),
    ):
        cloud(stage, data, **told)
        picture = drawn(stage).astype(int)
        for point, colour in zip(at, colours, strict=True):
            row, column = seen_at(point)
            assert abs(picture[row, column] - colour).max() <= 1, (told, point)
            half = FOCAL * 0.05 / (point[2] + 2) / 2  # of its square
            assert picture[row, round(column - half - 3)].tolist() == ground
            assert picture[round(row + half + 3), column].tolist() == ground
            assert picture[round(row - half + 2), round(column + half - 2)].tolist() != ground
    cloud(stage, data, colour="patch")
    stage.evaluate("(own) => view.cloud('a', { patchColours: new Uint8Array(own.flat()) })", own)
    picture = drawn(stage)
    for point, colour in zip(at[:3], own, strict=True):
        assert picture[seen_at(point)].tolist() == colour
    # moved by a matrix, hidden, and removed
    by = [[1, 0, 0, 0.1], [0, 1, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]
    stage.evaluate("(by) => view.cloud('a', { matrix: matrix.ofRows(by) })", by)
    moved = (at[1][0] + 0.1, at[1][1] + 0.2, at[1][2] + 0.3)
    picture = drawn(stage)
    assert picture[seen_at(moved)].tolist() == own[1]
    assert picture[seen_at(at[1])].tolist() == ground
    for off in ("view.cloud('a', { visible: false })", "view.remove('a')"):
        stage.evaluate(off)
        assert (drawn(stage) == blank).all()
    for point in at:
        there = stage.evaluate("(p) => view.project(p)", list(point))
        assert there[1::-1] == pytest.approx(seen_at(point), abs=0.5)
        assert there[2] == pytest.approx(point[2] + 2)


def test_pixels_before_the_first_frame_have_the_canvas_size(stage):
    told = stage.evaluate(
        """() => {
          const canvas = document.createElement("canvas");
          canvas.style.setProperty("width", "40px");
          canvas.style.setProperty("height", "30px");
          document.body.append(canvas);
          const early = viewer.createViewer(canvas, { label: "Early" });
          const sizes = [early.pixels().length, early.pixels(1, 1, 2, 2).length];
          early.destroy();
          return sizes; }"""
    )
    assert told == [40 * 30 * 4, 2 * 2 * 4]


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


def test_lines_and_triangles(stage):
    ground = drawn(stage)[0, 0].astype(int)
    stage.evaluate(
        """() => { view.lines("l", { positions: new Float32Array([-0.5, 0, 0, 0.5, 0, 0,
            0, 0.1, -9, 0, 0.1, 0]), tint: [255, 0, 0], width: 0.1 });
          view.triangles("t", { positions: new Float32Array([-0.4, 0.2, 0, 0.4, 0.2, 0, 0, 0.5, 0]),
            tint: [0, 200, 0] }); }"""
    )
    picture = drawn(stage).astype(int)
    for x in (-0.45, -0.2, 0.1, 0.45):  # a wish for a tenth of a pixel leaves one and a half
        row, column = seen_at((x, 0, 0))
        column_of = picture[row - 4 : row + 4, column]
        covered = abs(column_of - ground).sum(axis=1) / abs(np.array([255, 0, 0]) - ground).sum()
        assert covered.sum() == pytest.approx(1.5, abs=0.3)
    row, column = seen_at((0.6, 0, 0))
    assert (picture[row, column] == ground).all()
    row, column = seen_at((0, 0.1, 0))  # one end behind the eye: it comes from below
    for below in (10, 80, 125):  # above the triangle, and below it
        line = picture[row + below, column - 4 : column + 4]
        covered = abs(line - ground).sum(axis=1) / abs(np.array([255, 0, 0]) - ground).sum()
        assert covered.sum() == pytest.approx(1.5, abs=0.3)
    assert picture[seen_at((0.1, 0.3, 0))].tolist() == [0, 200, 0]
    assert (picture[seen_at((0.3, 0.45, 0))] == ground).all()
    shape = stage.evaluate(
        "[...viewer.frustum({width: 640, height: 480, fx: 585, fy: 585, cx: 320, cy: 240}, 2)]"
    )
    ends = np.array(shape).reshape(-1, 2, 3)
    assert ends[0, 1] == pytest.approx([-320.5 / 585 * 2, -240.5 / 585 * 2, 2])
    assert ends[2, 1] == pytest.approx([319.5 / 585 * 2, -240.5 / 585 * 2, 2])
    ring = np.array(stage.evaluate("[...viewer.frustum(null, 0.5)]")).reshape(-1, 3)
    assert abs(np.linalg.norm(ring[6:], axis=1) - 0.5).max() < 1e-6
    assert (ring[6:, 2] == 0).all()


@pytest.mark.thorough
def test_nothing_is_drawn_unless_something_changed(stage):
    cloud(stage, encode_points(np.array([(0.0, 0, 0)])))
    stage.evaluate(
        "() => new Promise((r) => requestAnimationFrame(() => requestAnimationFrame(r)))"
    )

    def frames() -> int:
        return int(stage.evaluate("view.frames"))

    first = frames()
    stage.wait_for_timeout(400)
    assert frames() == first
    light = drawn(stage)[0, 0].tolist()
    first = frames()
    stage.emulate_media(color_scheme="dark")
    stage.wait_for_function("first => view.frames > first", arg=first)  # the theme turned
    dark = drawn(stage)[0, 0].tolist()
    assert sum(dark) < 200 < sum(light)
    told = stage.evaluate("getComputedStyle(document.documentElement).getPropertyValue('--sunken')")
    assert "#" + bytes(dark).hex() == told.strip()


@pytest.mark.thorough
def test_hands_on_it(stage):
    before = stage.evaluate("view.camera")
    stage.locator("canvas").last.focus()
    stage.keyboard.press("ArrowRight")
    stage.keyboard.press("ArrowUp")
    now = stage.evaluate("view.camera")
    assert now["azimuth"] == pytest.approx(before["azimuth"] + 0.1)
    assert now["elevation"] == pytest.approx(0.1)
    stage.keyboard.press("+")
    assert stage.evaluate("view.camera.distance") == pytest.approx(2 / 1.25)
    stage.keyboard.press("Shift+ArrowLeft")
    assert stage.evaluate("view.camera.target") != before["target"]
    stage.evaluate("view.look({ target: [0, 0, 0], distance: 2, azimuth: 0, elevation: 0 })")
    stage.mouse.move(200, 150)
    stage.mouse.wheel(0, 200)
    stage.wait_for_timeout(100)
    assert stage.evaluate("view.camera.distance") == pytest.approx(2 * math.exp(0.3))
    stage.mouse.down()
    stage.mouse.move(260, 150)
    stage.mouse.up()
    assert stage.evaluate("view.camera.azimuth") == pytest.approx(math.pi * 60 / HEIGHT)
    stage.evaluate("view.look({ target: [0, 0, 0], distance: 2, azimuth: 0, elevation: 0 })")
    stage.keyboard.down("Shift")
    stage.mouse.move(200, 150)
    stage.mouse.down()
    stage.mouse.move(230, 140)  # what was at the middle comes along
    stage.mouse.up()
    stage.keyboard.up("Shift")
    assert stage.evaluate("view.project([0, 0, 0])")[:2] == pytest.approx([230, 140])
    cloud(stage, encode_points(np.array([(5.0, 0, 0), (6, 1, 1)])))
    stage.keyboard.press("0")
    assert stage.evaluate("view.camera.target")[0] == pytest.approx(5.5, abs=0.3)


@pytest.mark.thorough
def test_a_lost_context_comes_back_as_it_was(stage):
    rng = np.random.default_rng(4)
    cloud(stage, encode_points(rng.uniform(-0.5, 0.5, (200, 3)), patches=np.arange(200)),
          colour="patch")  # fmt: skip
    stage.evaluate(
        "view.lines('l', { positions: viewer.frustum(null, 0.4), colours: null, tint: 'query' })"
    )
    before = drawn(stage)
    stage.evaluate(
        """async () => {
          const heard = (type) => new Promise(
            (r) => canvas.addEventListener(type, r, { once: true }));
          const lose = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
          const [gone, back] = [heard("webglcontextlost"), heard("webglcontextrestored")];
          lose.loseContext();
          await gone;
          view.redraw();
          await new Promise((r) => setTimeout(r, 50));
          lose.restoreContext();
          await back;
        }"""
    )
    assert (drawn(stage) == before).all()
    assert len(np.unique(before.reshape(-1, 3), axis=0)) > 100


def test_pixels_are_no_denser_than_two(open_page, station):
    page = open_page(device_scale_factor=3)
    page.goto(station.home)
    told = page.evaluate(
        """async () => {
          const { createViewer } = await import(`${location.pathname}/viewer/viewer.js`);
          const canvas = document.createElement("canvas");
          canvas.style.setProperty("width", "200px");
          canvas.style.setProperty("height", "100px");
          document.body.append(canvas);
          const view = createViewer(canvas, { label: "x" });
          view.pixels();
          const first = [canvas.width, canvas.height];
          canvas.style.setProperty("width", "120px");
          await new Promise((r) => setTimeout(r, 200));
          return [first, [canvas.width, canvas.height]];
        }"""
    )
    assert told == [[400, 200], [240, 200]]
