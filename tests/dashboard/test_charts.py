"""Tests of charts: steps, paths and texts for screen readers."""

from __future__ import annotations

import pytest


@pytest.fixture
def call(run):
    """A function that runs statements with a module, `m`."""
    return lambda module, body: run(module, f"(async () => {{ {body} }})()")


def test_steps_of_an_axis(call):
    for most, count, least, wanted in [
        (0, 3, 0, [0, 0.5, 1]),
        (0, 3, 1, [0, 1]),
        (1, 3, 1, [0, 1]),
        (7, 3, 1, [0, 5, 10]),
        (20, 3, 1, [0, 10, 20]),
        (21, 3, 1, [0, 10, 20, 30]),
        (0.3, 3, 0, [0, 0.1, 0.2, 0.3]),
        (0.07, 3, 0, [0, 0.05, 0.1]),
        (1_999, 3, 1, [0, 1000, 2000]),
    ]:
        found = call("lib/scales", f"return m.steps({most}, {count}, {least})")
        assert found == wanted, (most, found)


def test_paths_leave_gaps_where_nothing_is_known(call):
    given = (
        "const v = [null, 1, 3, null, 2, null, 0, 4], x = (i) => 10 * i, y = (n) => 40 - 10 * n;"
    )
    told = call(
        "lib/scales", f"{given} return [m.linePath, m.dotPath, m.areaPath].map(f => f(v, x, y))"
    )
    assert told == [
        "M10 30L20 10M60 40L70 0",
        "M40 20h0",
        "M10 40L10 30L20 10L20 40ZM60 40L60 40L70 0L70 40Z",
    ]
    assert call("lib/scales", "return m.stacked([[1, null, 2], [3, 4, 0]])") == [
        [[0, 1], [0, 0], [0, 2]], [[1, 4], [0, 4], [2, 2]],
    ]  # fmt: skip


def test_labels_stand_at_whole_minutes_of_the_clock(call):
    given = "const t = Array.from({length: 60}, (_, i) => new Date(2026, 10, 22, 9, 47 + i));"
    told = call("lib/scales", f"{given} return m.timeTicks(t, 5).map((i) => m.clock(t[i]))")
    assert told == ["10:00", "10:15", "10:30", "10:45"]
    assert call("lib/scales", f"{given} return m.timeTicks(t, 1).map((i) => m.clock(t[i]))") == [
        "10:00"
    ]
    assert call("lib/scales", "return m.timeTicks([], 5)") == []


def test_a_chart_reads_out_what_the_keys_point_at_and_keeps_it(call, page):
    call("lib/charts", """
        const one = m.chart({title: "Apples", kind: "bars", format: (n) => `${n} pc`,
          series: [{name: "red", colour: "--bad"}, {name: "green", colour: "--good"},
            {name: "all", colour: "--ink", over: true}]});
        document.querySelector("main").append(one.element);
        const at = (i) => new Date(2026, 10, 22, 9, i);
        one.update([at(0), at(1), at(2), at(3)], [[1, 0, 5, 2], [3, 4, null, 1], [4, 4, 5, 3]]);
        window.later = () => one.update([at(1), at(2), at(3), at(4)],
          [[0, 5, 2, 7], [4, null, 1, 7], [4, 5, 3, 14]]);
    """)  # fmt: skip
    plot = page.get_by_role("slider", name="Apples")
    heights = lambda: [  # noqa: E731
        round(float(one.get_attribute("height")), 2)
        for one in plot.locator("svg rect:not(.chart-cursor)").all()
    ]
    # 118 px for 6: red of minutes 0, 2, 3, then green of 0, 1, 3
    assert heights() == [19.67, 98.33, 39.33, 59, 78.67, 19.67]
    told = lambda: plot.get_attribute("aria-valuetext")  # noqa: E731
    assert told() == "09:02: red 5 pc, green –, all 5 pc"  # the last minute that is over
    plot.focus()
    page.keyboard.press("Home")
    assert told() == "09:00: red 1 pc, green 3 pc, all 4 pc"
    page.keyboard.press("ArrowRight")
    assert told() == "09:01: red 0 pc, green 4 pc, all 4 pc"
    call("lib/charts", "window.later()")
    assert told() == "09:01: red 0 pc, green 4 pc, all 4 pc"  # stays with its minute
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "Apples"
    page.keyboard.press("End")
    assert told() == "09:04: red 7 pc, green 7 pc, all 14 pc"
    page.get_by_text("Show as table").click()
    rows = page.get_by_role("region", name="Apples, table").locator("tr").all_inner_texts()
    assert [row.split("\t") for row in rows] == [
        ["Minute", "red", "green", "all"],
        ["09:04", "7 pc", "7 pc", "14 pc"],
        ["09:03", "2 pc", "1 pc", "3 pc"],
        ["09:02", "5 pc", "–", "5 pc"],
        ["09:01", "0 pc", "4 pc", "4 pc"],
    ]


def test_a_hidden_page_asks_nothing_and_catches_up_when_it_is_seen(call, page):
    hide = (
        "Object.defineProperty(document, 'hidden', {get: () => window.away, configurable: true});"
    )
    asked = call("operations/poll", f"""{hide}
        const done = new AbortController(), wait = (ms) => new Promise((r) => setTimeout(r, ms));
        const turn = () => document.dispatchEvent(new Event("visibilitychange"));
        window.away = false;
        let n = 0;
        const faults = [];
        const ask = async () => {{ n += 1; if (n === 3) throw new Error("third"); }};
        const now = await m.poll(ask, 0.02, done.signal, (e) => faults.push(e.message));
        const first = n;
        while (n < 5) await wait(5);
        window.away = true; turn();
        await wait(60);
        const resting = n;
        await wait(120);
        const still = n;
        window.away = false; turn();
        const seen = n;
        done.abort();
        await wait(60);
        const over = n;
        now();
        return [first, faults, still - resting, seen - still, over - seen, n - over];
    """)  # fmt: skip
    assert asked == [1, ["third"], 0, 1, 0, 0]


def test_rows_that_stay_are_left_alone_and_focus_moves_to_what_replaced_its_row(call):
    told = call("operations/poll", """
        const list = document.createElement("ul");
        document.querySelector("main").append(list);
        const show = m.rows(list, (one) => one.id, (one) => {
          const row = document.createElement("li");
          row.innerHTML = `<button data-part="a"></button><details><summary>s</summary></details>
            <button data-part="b"></button>`;
          row.querySelector("[data-part=b]").textContent = one.text;
          return row;
        });
        const texts = () => [...list.children].map((row) => row.lastChild.textContent);
        show([{id: "x", text: "1"}, {id: "y", text: "2"}]);
        const [x, y] = list.children;
        y.querySelector("details").open = true;
        y.lastChild.focus();
        show([{id: "new", text: "0"}, {id: "x", text: "1"}, {id: "y", text: "2"}]);
        const focused = document.activeElement === y.lastChild;
        const kept = [list.children[1] === x, list.children[2] === y, focused, ...texts()];
        show([{id: "y", text: "3"}, {id: "new", text: "0"}]);
        const {textContent, dataset} = document.activeElement;
        const {open} = list.children[0].querySelector("details");
        return [kept, [textContent, dataset.part, open, ...texts()]];
    """)  # fmt: skip
    assert told == [[True, True, True, "0", "1", "2"], ["3", "b", True, "3", "0"]]
