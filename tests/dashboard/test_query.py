"""Tests of the query page against the API."""

import json
import math
import re

import numpy as np
import pytest

from tests.dashboard.conftest import colours, drawn, expect


def tiles(page, row):
    """What stands on the tiles of a row, in their order."""
    return page.locator(f"[data-row={row}] .query-tile").evaluate_all(
        """all => all.map(one => ({
            key: one.dataset.key, status: one.dataset.status ?? null, text: one.innerText,
            rank: Number(one.querySelector(".query-rank").textContent),
            figures: Object.fromEntries([...one.querySelectorAll("dt")].map(
                (term) => [term.textContent, term.nextSibling.textContent])),
        }))"""
    )


def key(one):
    return f"{one['map']}/{one['frame_id']}"


#: Where circles of a plan stand, in its pixels; and its projection: the origin, and a metre.
SPOTS = "all => all.map(one => [Number(one.getAttribute('cx')), Number(one.getAttribute('cy'))])"
VIEW = """() => { const view = document.querySelector(".plan").plan.view;
    return [view.x(0), view.y(0), view.scale]; }"""


def at(view, u, v):
    """The pixel of a place of the plan, metres to the right and to the top."""
    return [view[0] + u * view[2], view[1] - v * view[2]]


@pytest.fixture
def ask(station, page, settle):
    """Open the page that asks with a frame, and unfold why; returns the answer that it shows, as
    the API has it.
    """

    def open_it(search="", frame=0, why="&why=open"):
        page.goto("about:blank")
        address = f"{station.home}#/maps/building/query?frame={station.frames[frame].frame_id}"
        page.goto(address + why + search)
        settle(page)
        return shown(station, page)

    return open_it


def shown(station, page):
    """The answer that the page shows, as the API has it."""
    link = page.locator(".query-verdict-links a", has_text="Answer").get_attribute("href")
    reply = station.client.get(f"/v1/queries/{link.rpartition('/')[2]}")
    assert reply.status_code == 200
    return reply.json()


def accepted(answer):
    """Ids of the accepted matches that an answer lists."""
    return [m["frame_id"] for m in answer["matches"] if m["validation"]["status"] == "accepted"]


def test_the_rows_are_the_answer(station, page, ask, axe, written):
    answer = ask("&k=2&candidates=4")
    frame_id = station.frames[0].frame_id
    body = {"frame_id": frame_id, "k": 2, "candidates": 4, "explain": True}
    again = station.client.post("/v1/maps/building/queries", json=body).json()
    for name in ("matches", "explanations", "counts", "location", "status"):
        assert again[name] == answer[name]  # the page asks as one asks by hand
    ranking, selection, validated = (tiles(page, row) for row in ("R", "DR", "VDR"))
    assert [e["key"] for e in ranking] == [key(e) for e in answer["explanations"]]
    for tile, explanation in zip(ranking, answer["explanations"], strict=True):
        assert tile["rank"] == explanation["rank"]
        assert f"distance {explanation['distance']:,}" in tile["text"]
        similar = 100 * explanation["similarity"]
        digits = 2 if 0 < similar < 1 else 1 if similar < 10 else 0
        assert f"similar {similar:.{digits}f} %" in tile["text"]
    chosen = sorted(answer["matches"], key=lambda one: one["rank"])
    assert [one["key"] for one in selection] == [key(one) for one in chosen]
    for tile, explanation in zip(selection, chosen, strict=True):
        assert f"gain {round(explanation['diversity_gain'], 2):g}" in tile["text"]
    assert [match["key"] for match in validated] == [key(match) for match in answer["matches"]]
    for tile, explanation in zip(validated, answer["matches"], strict=True):
        validation = explanation["validation"]
        assert tile["status"] == validation["status"]
        assert written(validation["reason"]) in tile["text"]
        if validation["inliers"] is not None:
            assert tile["figures"]["Inliers"] == f"{validation['inliers']:,}"
            assert tile["figures"]["Overlap"] == f"{100 * validation['overlap']:.0f} %"
            turn = validation["residual"]["rotation_deg"]
            assert tile["figures"]["Residual"].endswith(f", {turn:.{1 if turn < 10 else 0}f}°")
    counts = page.locator(".query-step").evaluate_all(
        "all => Object.fromEntries(all.map(one => [one.dataset.step,"
        " one.querySelector('.query-step-count').textContent]))"
    )
    assert counts == {name: str(n) for name, n in answer["counts"].items()}
    # a frame that fell out is followed through the rows
    lost = next(e for e in answer["explanations"] if e["outcome"] == "not_selected")
    page.locator(f"[data-row=R] [data-key='{key(lost)}'] button").click()
    page.mouse.move(0, 0)
    assert page.locator("[data-row=R] .is-marked").count() == 1
    assert page.locator("[data-row=DR] .is-marked").count() == 0
    trace = page.locator("[data-row=DR] .query-trace")
    assert trace.inner_text() == f"Lost here: {lost['reason']}"
    best = key(answer["matches"][0])
    page.locator(f"[data-row=R] [data-key='{best}'] button").click()
    page.mouse.move(0, 0)
    assert page.locator(f".is-marked[data-key='{best}']").count() == 3
    overlay = page.locator(f"[data-row=VDR] [data-key='{best}'] .query-overlay")
    match = best.partition("/")[2]
    assert overlay.get_attribute("href") == (
        f"#/queries/{answer['query_id']}/matches/{match}?map=building"
    )
    assert axe(page) == []


@pytest.mark.parametrize(
    ("search", "status", "title"),
    [
        ("", "found", "Found, 99."),
        pytest.param(
            "&ambiguous=0&confidence=0.999", "ambiguous", "Ambiguous, ", marks=pytest.mark.thorough
        ),
        pytest.param(
            "&stages=retrieve", "unvalidated", "Not validated.", marks=pytest.mark.thorough
        ),
        ("&session=nobody", "not_found", "Not found."),
    ],
)
def test_the_verdict_is_the_status(page, ask, search, status, title):
    answer = ask(search)
    assert answer["status"] == status
    verdict = page.locator(".query-verdict")
    assert verdict.get_attribute("data-status") == status
    said = verdict.locator("p").first.inner_text()
    assert said.startswith(title)
    if status == "found":
        p = answer["location"]["pose"]["translation"]
        assert f"x {round(p['x'], 2):g}, y {round(p['y'], 2):g}, z {round(p['z'], 2):g} m" in said
        assert answer["location"]["pose"]["parent_frame"] in said
    if search == "&stages=retrieve":
        assert tiles(page, "VDR") == tiles(page, "DR") == []


@pytest.mark.thorough
def test_an_ambiguous_answer_lists_poses_of_one_rank(station, page, four_sides, settle, axe):
    assert (four_sides["status"], four_sides["location"]) == ("ambiguous", None)
    several = four_sides["alternatives"]
    # the cube turned by 90, 180 and 270 degrees; the sensor is 1.8 m from its axis
    assert len(several) >= 4
    page.goto(f"{station.home}#/queries/{four_sides['query_id']}?why=open")
    settle(page)
    verdict = page.locator(".query-verdict")
    said = verdict.inner_text()
    reason = four_sides["reason"]
    sure = f"{math.floor(1000 * four_sides['alternatives'][0]['confidence']) / 10:.1f} %"
    assert f"Ambiguous, best pose {sure} sure. {reason[0].upper()}{reason[1:]}." in said
    assert "Do not act on any of these poses. Move on and query again" in said
    assert "found" not in said.lower()
    assert "agree" not in said.lower()
    items = page.locator(".alternatives li").evaluate_all(
        """all => all.map(one => ({
            letter: one.querySelector(".alternatives-letter").textContent,
            place: one.querySelector(".alternatives-place").textContent,
            figures: [...one.querySelectorAll("dd")].map((each) => each.textContent),
            bars: [...one.querySelectorAll(".alternatives-bar > span")].map(
                (each) => each.style.width),
            why: one.querySelector(".alternatives-why").textContent,
        }))"""
    )
    for i, (item, alternative) in enumerate(zip(items, several, strict=True)):
        assert item["letter"] == "ABCDE"[i]
        p = alternative["pose"]["translation"]
        place = ", ".join(f"{axis} {round(p[axis], 2):g}" for axis in "xyz")
        assert item["place"].startswith(place)
        assert item["place"].endswith(" from A") == (i > 0)
        support = alternative["support"]
        supported = f"{support} match{'es' if support > 1 else ''}" if support else "the map alone"
        sure, score = alternative["confidence"], alternative["evidence"]["score"]
        assert item["figures"] == [
            f"{math.floor(1000 * sure) / 10:.1f} %", f"{100 * score:.0f} %", supported
        ]  # fmt: skip
        assert [float(bar.removesuffix("%")) for bar in item["bars"]] == [
            pytest.approx(100 * sure, abs=0.1), pytest.approx(100 * score, abs=0.1)
        ]  # fmt: skip
        assert " of the map agree, " in item["why"]
    confidences = page.locator(".plan .query-spot-sure").all_text_contents()
    assert confidences == [item["figures"][0] for item in items]
    fit = several[1]["evidence"]["score"] / several[0]["evidence"]["score"]
    assert f"from A, fits {100 * fit:.0f} % as well" in said
    # each match stands with the pose that it votes for
    votes = page.locator("[data-row=VDR] .query-vote").all_inner_texts()
    support = {f"for pose {'ABCDE'[i]}": one["support"] for i, one in enumerate(several)}
    voting = sum(match["validation"]["status"] == "ambiguous" for match in four_sides["matches"])
    assert len(votes) == voting
    for letter, number in support.items():
        assert votes.count(letter) == number
    settle(page)
    assert axe(page) == []
    page.set_viewport_size({"width": 390, "height": 844})
    assert page.evaluate("document.documentElement.scrollWidth") <= 390


@pytest.mark.thorough
def test_the_plan_and_the_overlay_are_on_the_first_screen(station, page, ask, settle):
    page.set_viewport_size({"width": 1440, "height": 900})
    answer = ask(why="")
    plan, inset = page.locator(".query-plan .plan"), page.locator(".query-inset-canvas")
    for element in (page.locator(".query-verdict"), plan, inset):
        box = element.bounding_box()
        assert box["y"] + box["height"] <= 900
    assert page.locator(".query-row").count() == 0  # folded, and not drawn before it is asked for
    # the room's z is up: x and y are those of the plan, and a camera looks along its own z
    pose = np.array(answer["location"]["pose"]["matrix"])
    view = page.evaluate(VIEW)
    arrow = page.locator(".plan .query-spot-found")
    x, y, turn = map(float, re.findall(r"-?[\d.]+", arrow.get_attribute("transform")))
    assert [x, y] == pytest.approx(at(view, *pose[:2, 3]), abs=0.2)
    assert 90 - turn == pytest.approx(np.degrees(np.arctan2(pose[1, 2], pose[0, 2])), abs=0.1)
    covariance = np.reshape(answer["location"]["uncertainty"]["covariance"], (6, 6))[:2, :2]
    ellipse = page.locator(".plan .query-ellipse")
    axes = [float(ellipse.get_attribute(name)) for name in ("ry", "rx")]
    # chi-squared of two degrees of freedom: 95 % lie within -2 ln 0.05
    assert axes == pytest.approx(
        np.sqrt(np.linalg.eigvalsh(covariance) * -2 * np.log(0.05)), rel=1e-3
    )
    voting = [match for match in answer["matches"] if match["validation"]["status"] == "accepted"]
    assert page.locator(".plan .query-vote-line").count() == len(voting)
    # each match stands where its frame was taken
    taken = {frame.frame_id: frame.meta["pose"]["matrix"] for frame in station.frames}
    for match in voting:
        mark = page.locator(f".plan .query-spot-match[data-key='{key(match)}']")
        x, y, _ = map(float, re.findall(r"-?[\d.]+", mark.get_attribute("transform")))
        own = np.array(taken[match["frame_id"]])
        assert [x, y] == pytest.approx(at(view, *own[:2, 3]), abs=0.15 * view[2])


def test_what_a_found_pose_rests_on_is_told_in_words(run):
    def reasons(**change):
        pose = {"parent_frame": "hall", "translation": {"x": 1, "y": 2, "z": 0.5}}
        location = {
            "map": "house", "pose": pose, "support": 3, "guided": 0, "votes": 3,
            "strength": "strong", "verified_by": "matches", "confidence": 0.99676,
            "evidence": {"planes": 19.6, "frames": 9, "excess": 0.012, "rival": 0.42},
            "spread_m": 0.02, "spread_deg": 0.5, "uncertainty": None, **change,
        }  # fmt: skip
        answer = {
            "status": "found", "reason": "3 of 3", "cause": None, "matches": [], "counts": {},
            "alternatives": [], "maps": ["house"], "location": location,
        }  # fmt: skip
        one = run("query/words", "m.verdict(given[0])", answer)
        assert one["text"] == "In map house, at x 1, y 2, z 0.5 m in hall."
        return one["details"], one["kind"], one["title"]

    seen = "20 planes and 9 frames of the map agree, 1.2 % is missing, "
    near = f"{seen}the next best place fits 42 % as well"
    firm = "3 of 3 accepted matches agree on this pose, within 20 mm, 0.5°"
    title = "Found, 99.6 % sure"  # rounded down
    assert reasons() == ([near, firm, "strong matches"], "good", title)
    alone = {"planes": 1.2, "frames": 1, "excess": -0.01, "rival": 0.04}
    assert reasons(support=1, votes=1, evidence=alone, confidence=0.99996) == (
        ["1 plane and 1 frame of the map agree, nothing is missing, no other place fits",
         "one view", "strong match"], "good", "Found, 99.9 % sure"
    )  # fmt: skip
    assert reasons(support=0, votes=0, verified_by="map", strength="weak")[:2] == (
        [near, "confirmed by the map’s frames", "no accepted match"], "good"
    )  # fmt: skip
    # found with less confidence than the default, or without one
    assert reasons(confidence=0.9)[1:] == ("warn", "Found, 90.0 % sure")
    assert reasons(confidence=None)[1:] == ("warn", "Found")


@pytest.mark.thorough
def test_a_control_asks_again(station, page, ask, settle):
    first = ask()
    sent = []
    page.on("request", lambda one: one.method == "POST" and sent.append(one))
    page.locator(".query-panel > summary").click()
    page.locator(".query-group > summary", has_text="Validation").click()
    field = page.locator("#ask-residual_m")
    assert field.input_value() == "0.08"  # the default of the map's model
    field.fill("0.00001")
    field.press("Enter")
    page.wait_for_timeout(400)  # it waits for the last of several changes
    settle(page)
    assert len(sent) == 1
    body = json.loads(sent[0].post_data)
    assert body["validation"] == {"residual_m": 0.00001}
    assert "k" not in body  # what is default is left to the service
    second = shown(station, page)
    assert (first["status"], second["status"]) == ("found", "not_found")
    changed = page.locator(".query-changed").inner_text()
    assert "not found (was found)" in changed
    assert f"accepted {first['counts']['accepted']} → 0" in changed


@pytest.mark.thorough
def test_why_not_is_told_as_the_api_explains_it(station, page, ask, settle, written):
    answer = ask("&k=1&candidates=4&session=room-0/ann,room-0/bob,room-1/ann")
    options = {
        "k": 1, "candidates": 4, "filter": {"session": ["room-0/ann", "room-0/bob", "room-1/ann"]}
    }  # fmt: skip
    ids = [frame.frame_id for frame in station.frames]
    steps = {"query": "map", "filter": "passed", "selection": "selected", "turn": "validated"}
    seen = set()
    out = next(e for e in answer["explanations"] if e["outcome"] == "not_selected")
    [listed] = accepted(answer)
    after = next(
        explanation["frame_id"]
        for explanation in answer["explanations"]
        if explanation["outcome"] == "accepted" and explanation["frame_id"] != listed
    )
    for frame_id in (ids[0], ids[9], listed, after, out["frame_id"]):
        record = station.client.post(
            "/v1/maps/building/queries",
            json={"frame_id": ids[0], "explain_frame": frame_id, **options},
        ).json()["explained_frame"]
        page.locator("#why-frame").fill(frame_id)
        page.locator("#why-frame").press("Enter")
        settle(page)
        head = page.locator(".query-why-head")
        assert head.get_attribute("data-lost") == (record["lost_at"] or "none")
        said = page.locator(".query-why-result").inner_text()
        assert written(record["reason"][1:]).replace("`", "") in said  # code is shown as code
        if record["rank"] is not None:
            assert f"{record['rank']} of {record['of']}" in said
            assert f"{record['distance']:,}" in said
        marked = page.locator(".query-step[data-lost=here], .query-step[data-lost=not]")
        step = steps.get(record["lost_at"], "accepted")
        assert marked.evaluate_all("all => all.map(one => one.dataset.step)") == [step]
        seen.add(record["lost_at"])
    assert seen == {"query", "filter", "selection", "turn", None}


@pytest.mark.thorough
def test_a_file_is_asked_and_looked_at_again(station, page, settle, axe):
    """It is sent once: the kept answer is asked with every change, and by who has its id."""
    frame = station.frames[3]
    sent = []
    page.on("request", lambda one: one.method == "POST" and sent.append(one.url))
    page.goto(f"{station.home}#/maps/building/query")
    settle(page)
    camera = json.dumps(frame.meta["intrinsics"]).encode()
    page.locator("#ask-file").set_input_files([
        {"name": "view.png", "mimeType": "image/png", "buffer": frame.png},
        {"name": "intrinsics.json", "mimeType": "application/json", "buffer": camera},
    ])  # fmt: skip
    page.locator(".query-verdict").wait_for()
    settle(page)
    first = shown(station, page)
    assert first["frame"] is None
    assert first["matches"][0]["frame_id"] == frame.frame_id  # it finds itself in the map
    page.locator(".query-panel > summary").click()
    page.locator("#ask-k").fill("1")
    page.locator("#ask-k").press("Enter")
    page.wait_for_timeout(400)
    settle(page)
    answer = shown(station, page)
    assert len(accepted(answer)) == 1
    assert [path.partition("/v1/")[2] for path in sent] == [
        "maps/building/queries", "queries",
    ]  # fmt: skip
    assert first["query_id"] != answer["query_id"]
    page.goto(f"{station.home}#/queries/{answer['query_id']}?why=open")
    settle(page)
    painted = drawn(page.locator(".query-asked canvas"))
    depth = station.client.get(
        f"/v1/queries/{answer['query_id']}/preview.png", params={"view": "depth", "width": 192}
    )
    assert np.array_equal(painted, colours(depth.content))
    assert "with an uploaded depth image" in page.locator(".query-note").first.inner_text()
    assert axe(page) == []


@pytest.mark.thorough
def test_an_answer_is_kept_shared_and_released(station, open_page, settle, axe, until):
    page = open_page(permissions=["clipboard-read", "clipboard-write"])
    frame = station.frames[2].frame_id
    body = {"frame_id": frame, "k": 3}
    query_id = station.client.post("/v1/maps/building/queries", json=body).json()["query_id"]
    path = f"/v1/queries/{query_id}/question"
    page.goto(f"{station.home}#/queries/{query_id}")
    settle(page)
    panel = page.get_by_role("group", name="Keep this answer")
    expect(panel).to_contain_text("This answer expires in")
    panel.get_by_role("button", name="Keep answer").click()
    panel.get_by_role("button", name="Copy link").click()
    expect(page.locator(".toast", has_text="The link was copied.")).to_be_visible()
    assert page.evaluate("() => navigator.clipboard.readText()") == page.url
    assert station.client.get(path).json()["kept_at"] is not None
    assert axe(page) == []
    listed = f"{station.home}#/maps/building/queries?kept=true"
    page.goto(listed)
    settle(page)
    row = page.locator(f"[data-query='{query_id}']")
    expect(row).to_contain_text("kept")
    row.get_by_role("link", name="Answer").click()
    settle(page)
    panel.get_by_role("button", name="Release").click()
    expect(panel.get_by_role("button", name="Keep answer")).to_be_visible()
    assert station.client.get(path).json()["kept_at"] is None
    page.goto(listed)
    settle(page)
    expect(row).to_have_count(0)


@pytest.mark.thorough
def test_an_answer_is_reconstructed(station, page, ask, settle, with_open3d):
    answer = ask("&k=3")
    page.goto(f"{station.home}#/queries/{answer['query_id']}")
    settle(page)
    card = page.locator("section", has=page.get_by_role("heading", name="Reconstruction"))
    card.get_by_role("button", name="Reconstruct").click()
    mesh = card.get_by_role("button", name="Mesh (PLY)")
    expect(mesh).to_be_visible(timeout=120_000)
    job = page.url.rpartition("reconstruction=")[2]
    record = station.client.get(f"/v1/reconstructions/{job}").json()
    assert record["query_id"] == answer["query_id"]
    expect(card).to_contain_text(f"{len(record['result']['views'])} views show")
    expect(card).to_contain_text(f"{record['result']['area_m2']:.1f} m²")
    with page.expect_download() as download:
        mesh.click()
    ply = station.client.get(f"/v1/reconstructions/{job}/mesh.ply").content
    assert download.value.path().read_bytes() == ply
    page.reload()  # the address has it
    settle(page)
    expect(mesh).to_be_visible()
