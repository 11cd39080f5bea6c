"""Tests of charts: steps, paths and texts for screen readers."""

import pytest


@pytest.fixture
def call(run):
    """A function that runs statements with a module, `m`."""
    return lambda module, body: run(module, f"(async () => {{ {body} }})()")


def test_steps_of_an_axis(call):
    for most, count, least, wanted in [
        (0, 3, 0, [0, 0.5, 1]),
        (21, 3, 1, [0, 10, 20, 30]),
    ]:
        result = call("lib/scales", f"return m.steps({most}, {count}, {least})")
        assert result == wanted, (most, result)


def test_paths_leave_gaps_where_nothing_is_known(call):
    values = (
        "const v = [null, 1, 3, null, 2, null, 0, 4], x = (i) => 10 * i, y = (n) => 40 - 10 * n;"
    )
    result = call(
        "lib/scales", f"{values} return [m.linePath, m.dotPath, m.areaPath].map(f => f(v, x, y))"
    )
    assert result == [
        "M10 30L20 10M60 40L70 0",
        "M40 20h0",
        "M10 40L10 30L20 10L20 40ZM60 40L60 40L70 0L70 40Z",
    ]
    assert call("lib/scales", "return m.stacked([[1, null, 2], [3, 4, 0]])") == [
        [[0, 1], [0, 0], [0, 2]], [[1, 4], [0, 4], [2, 2]],
    ]  # fmt: skip


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
        round(float(bar.get_attribute("height")), 2)
        for bar in plot.locator("svg rect:not(.chart-cursor)").all()
    ]
    # 118 px for 6: red of minutes 0, 2, 3, then green of 0, 1, 3
    assert heights() == [19.67, 98.33, 39.33, 59, 78.67, 19.67]
    value = lambda: plot.get_attribute("aria-valuetext")  # noqa: E731
    assert value() == "09:02: red 5 pc, green –, all 5 pc"  # the last minute that is over
    plot.focus()
    page.keyboard.press("Home")
    assert value() == "09:00: red 1 pc, green 3 pc, all 4 pc"
    page.keyboard.press("ArrowRight")
    assert value() == "09:01: red 0 pc, green 4 pc, all 4 pc"
    call("lib/charts", "window.later()")
    assert value() == "09:01: red 0 pc, green 4 pc, all 4 pc"  # stays with its minute
    assert page.evaluate("document.activeElement.getAttribute('aria-label')") == "Apples"
    page.keyboard.press("End")
    assert value() == "09:04: red 7 pc, green 7 pc, all 14 pc"
