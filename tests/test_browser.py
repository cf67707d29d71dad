"""The page in a browser: no errors, episodes that can be chosen, watched and compared. Needs Chromium."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from benchmarks import report
from benchmarks.explorer import trajectory_jobs
from benchmarks.html_report import write_page
from benchmarks.jobs import evaluation_jobs
from benchmarks.protocol import make_plan
from benchmarks.results import merge
from rise_agents.agent import silent

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"
CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
]


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A run of both tasks by who needs no training; its jobs done here."""
    out = tmp_path_factory.mktemp("run")
    plan = make_plan(
        "smoke",
        {},
        agents=("expert-cbf", "random"),
        envs=(VEHICLE, PANDA),
        episodes=8,
        noise_levels=(0.0, 1.0),
    )
    evaluations, traces = evaluation_jobs(plan, out), trajectory_jobs(plan, out)
    for job in (*evaluations, *traces):
        assert all(path.exists() for path in job.needs)
        job.output.parent.mkdir(parents=True, exist_ok=True)
        job.run(job.output, silent, **job.arguments)
    names = [str(job.output.relative_to(out)) for job in traces]
    known = {"rows": ["expert-cbf", "random"], "trajectories": names, "command": "python -m benchmarks.run"}
    for seed in range(5):  # made up: nobody is trained here
        points = [{"share": share / 10, "loss": 1 / (1 + share + seed)} for share in range(11)]
        (out / f"{seed}.json").write_text(json.dumps({"curve": points}))
    known["agents"] = {VEHICLE: {f"random-seed{seed}": f"{seed}.rise" for seed in range(5)}}
    known["training"] = {"random": {"updates": 1}}
    summary = report.publish(merge([job.output for job in evaluations], out / "episodes.parquet"), known, out)
    write_page(summary, known, out, out)
    return out


def test_trajectories_are_of_the_same_scenarios_for_all_agents(run):
    from benchmarks.trajectories import load

    files = sorted((run / "trajectories").iterdir())
    assert len(files) == 2 * 2 * 2  # tasks, rows, levels
    for env in (VEHICLE, PANDA):
        of_env = [load(path) for path in files if path.name.startswith(env)]
        assert len({tuple(sorted(episodes)) for episodes, _ in of_env}) == 1
        assert all(facts["differing"] == [] for _, facts in of_env)


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine (Debian: apt-get install chromium)")
    playwright = pytest.importorskip(
        "playwright.sync_api", reason="needs playwright: pip install 'rise-suite[dev]'"
    )
    with playwright.sync_playwright() as started:
        opened = started.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield opened
        opened.close()


@pytest.fixture
def page(browser, run):
    """The page, wide; afterwards it must have had no errors and asked for nothing."""
    context = browser.new_context(viewport={"width": 1280, "height": 900})
    opened, wrong, asked = context.new_page(), [], []
    opened.on(
        "console",
        lambda message: wrong.append(message.text) if message.type in ("error", "warning") else None,
    )
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("request", lambda request: asked.append(request.url))
    address = (run / "report.html").as_uri()
    opened.goto(address)
    opened.wait_for_selector("html[data-ready=yes]", timeout=120_000)
    yield opened
    context.close()
    assert wrong == []
    assert [url for url in asked if not url.startswith(("data:", "blob:"))] == [address]


def picture(page, number: int = 0) -> str:
    return page.locator("#player figure canvas").nth(number).evaluate("canvas => canvas.toDataURL()")


def choose(page, part: str, value: str) -> None:
    page.select_option(f"#player [data-part={part}]", value)


def shown(page) -> tuple[float, str]:
    time = float(page.locator("#player [data-part=scrub]").input_value())
    return time, page.locator("#player [data-part=rows] tr.current").get_attribute("data-scenario")


@pytest.mark.parametrize("task", ["0", "1"])
def test_an_episode_is_chosen_watched_and_compared(page, task):
    choose(page, "task", task)
    choose(page, "agent", "1")
    choose(page, "other", "-1")
    choose(page, "level", "0")
    assert page.locator("#player figure").count() == 1
    before = picture(page)
    page.locator("#player [data-part=rows] tr:not(.current)").first.click()
    clicked = picture(page)
    assert clicked != before and "random" in page.locator("#player [data-part=command]").inner_text()
    page.locator("#player [data-part=scrub]").fill("3.5")
    assert picture(page) != clicked
    choose(page, "other", "0")
    assert page.locator("#player figure").count() == 2
    names = page.locator("#player figcaption strong").all_inner_texts()
    assert names == ["Random", "Expert (cbf)"]
    assert page.locator("#player [data-part=rows] tr").nth(0).locator("td").count() == 2
    assert picture(page, 0) != picture(page, 1)


def until(page, condition: str) -> None:
    """Wait for it; not by ``wait_for_function``, which needs an eval that the page's policy forbids."""
    for _ in range(300):
        if page.evaluate(condition):
            return
        page.wait_for_timeout(100)
    raise AssertionError(condition)


def test_a_click_plays_the_episode_where_it_can_be_seen(browser, run):
    context = browser.new_context(viewport={"width": 390, "height": 844})
    page = context.new_page()
    page.goto((run / "report.html").as_uri())
    page.wait_for_selector("html[data-ready=yes]", timeout=120_000)
    row = page.locator("#player [data-part=rows] tr").last
    row.scroll_into_view_if_needed()
    row.click()
    until(page, "explorer.time > 0")
    until(
        page,
        """() => {
            const [nav, panels] = ["nav", "#player [data-part=panels]"].map(
                (each) => document.querySelector(each).getBoundingClientRect()
            );
            return nav.bottom <= panels.top + 1 && panels.bottom <= innerHeight;
        }""",
    )
    context.close()
    still = browser.new_context(reduced_motion="reduce")
    page = still.new_page()
    page.goto((run / "report.html").as_uri())
    page.wait_for_selector("html[data-ready=yes]", timeout=120_000)
    page.locator("#player [data-part=rows] tr").last.click()
    assert not page.evaluate("explorer.playing")
    still.close()


def test_the_list_is_sorted_by_whose_clearance_one_clicks(page):
    choose(page, "agent", "1")
    choose(page, "other", "0")
    heads, least = page.locator("#player [data-part=head] button"), {}
    for column in (1, 2):
        heads.nth(column).click()
        cells = page.locator(
            f"#player [data-part=rows] tr td:nth-child({column + 1}) small"
        ).all_inner_texts()
        least[column] = [float(cell.replace("−", "-").removesuffix("\xa0m")) for cell in cells]
        assert least[column] == sorted(least[column]) and len(least[column]) > 3
        assert (
            page.locator("#player th[aria-sort]").inner_text().split()[0] == ("Random", "Expert")[column - 1]
        )
    assert least[1] != least[2]
    heads.nth(0).click()
    numbers = page.locator("#player [data-part=rows] tr").evaluate_all(
        "all => all.map(e => +e.dataset.scenario)"
    )
    assert numbers == sorted(numbers)


@pytest.mark.parametrize("task", ["0", "1"])
def test_no_place_of_the_robot_is_out_of_the_picture(page, task):
    choose(page, "task", task)
    choose(page, "agent", "1")
    for row in page.locator("#player [data-part=rows] tr").all():
        row.locator("button").press("Enter")
        outside = page.evaluate(
            """() => explorer.scenes.flatMap((scene) => {
                const at = scene.task.dim === 3 ? (p) => new Camera(scene).at(p) : null;
                const steps = [...Array(scene.episode.steps + 1).keys()];
                const places = steps.map((t) => Array.from(scene.data.position(t)));
                const { low, high } = scene.bounds, inside = (p) => p.every((v, i) => v >= low[i] && v <= high[i]);
                const within = ([x, y]) => x > 0 && x < scene.width && y > 0 && y < scene.height;
                const drawn = (p) => !at || within(at(p));
                return places.filter((p) => !inside(p) || !drawn(p));
            })"""
        )
        assert outside == []


def test_the_keyboard_plays_steps_and_changes_the_scenario(page):
    page.locator("#player").focus()
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowRight")
    time, scenario = shown(page)
    assert time == 2
    page.keyboard.press("ArrowLeft")
    assert shown(page)[0] == 1
    page.keyboard.press("End")
    assert shown(page)[0] == page.evaluate("explorer.length")
    page.keyboard.press("ArrowDown")
    assert shown(page)[0] == 0 and shown(page)[1] != scenario
    page.keyboard.press(" ")
    until(page, "explorer.time > 0")
    page.keyboard.press(" ")
    assert not page.evaluate("explorer.playing")


def test_a_drag_turns_the_arm_and_only_the_arm(page):
    choose(page, "task", "1")
    canvas = page.locator("#player figure canvas").first
    canvas.scroll_into_view_if_needed()
    before, box = picture(page), canvas.bounding_box()
    page.mouse.move(box["x"] + 100, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + 180, box["y"] + 120)
    page.mouse.up()
    assert picture(page) != before
    assert shown(page)[0] == 0


def test_the_numbers_in_the_browser_are_those_of_the_files(page, run):
    """The script's own decoding against what was stored: the place of the robot, and how clear it is."""
    from benchmarks.trajectories import load

    for path in sorted((run / "trajectories").iterdir()):
        episodes, facts = load(path)
        for scenario, truth in episodes.items():
            found = page.evaluate(
                """([env, row, level, scenario]) => {
                    const task = explorer.tasks.find((each) => each.env === env);
                    const agent = task.agents.findIndex((each) => each.row === row);
                    const fits = (e) => e.agent === agent && e.level === level && e.scenario === scenario;
                    const episode = task.episodes.find(fits), data = decoded(task, episode, explorer.numbers);
                    return [...Array(episode.steps + 1).keys()].map((t) => [...data.position(t), ...data.clearance(t)]);
                }""",
                [facts["env"], facts["row"], facts["noise_level"], scenario],
            )
            dim = len(facts["low"])
            assert len(found) == len(truth.state)
            for t, values in enumerate(found):
                assert values[:dim] == pytest.approx(truth.state[t, :dim], abs=1e-3)
                assert values[dim] == pytest.approx(truth.clearance[t], abs=1e-3)


def test_collisions_can_be_picked_out(page):
    choose(page, "agent", "1")
    choose(page, "which", "unsafe")
    words = page.locator("#player [data-part=rows] tr td:nth-child(2)").all_inner_texts()
    assert all("collision" in each for each in words)
    choose(page, "which", "drawn")
    assert page.locator("#player [data-part=rows] tr").count() >= 1


def test_where_no_episode_fits_none_is_shown(page):
    found = set()
    for agent in page.locator("#player [data-part=agent] option").all():
        choose(page, "agent", agent.get_attribute("value"))
        for level in page.locator("#player [data-part=level] option").all():
            choose(page, "level", level.get_attribute("value"))
            for which in ("unsafe", "critical"):
                choose(page, "which", which)
                some = page.locator("#player [data-part=rows] tr").count() > 0
                assert page.locator("#player [data-part=panels]").is_visible() == some
                assert page.get_by_text("No such episode").is_visible() == (not some)
                found.add(some)
    assert found == {True, False}


def test_charts_are_drawn(page):
    assert page.locator(".chart .main-svg").count() >= 8
    assert page.locator(".chart .bars path").count() >= 8


def test_the_list_follows_the_scenario_that_is_watched(page):
    page.set_viewport_size({"width": 600, "height": 900})  # where the list is low
    page.locator("#player").focus()
    for _ in range(page.locator("#player [data-part=rows] tr").count()):
        page.keyboard.press("ArrowDown")
    last, around = page.evaluate(  # of one moment: the page may be scrolling
        """() => ["#player [data-part=rows] tr:last-child", "#player .episodes"].map(
            (each) => document.querySelector(each).getBoundingClientRect().bottom
        )"""
    )
    assert last <= around + 2


def test_no_words_of_a_chart_lie_on_each_other(browser, run):
    for width in (390, 1280):
        context = browser.new_context(viewport={"width": width, "height": 844})
        page = context.new_page()
        page.goto((run / "report.html").as_uri())
        page.wait_for_selector("html[data-ready=yes]", timeout=120_000)
        assert page.locator("#training .legend").count() == 1
        overlapping = page.evaluate(
            """() => [...document.querySelectorAll(".chart")].filter((chart) => {
                const found = [".legend", ".xtitle"].map((each) => chart.querySelector(each)?.getBoundingClientRect());
                if (found.some((box) => !box)) return false;
                const [legend, title] = found;
                return legend.top < title.bottom && title.top < legend.bottom;
            }).map((chart) => chart.innerText.slice(0, 80))"""
        )
        assert overlapping == []
        context.close()


def test_a_phone_needs_no_scrolling_sideways(browser, run):
    context = browser.new_context(viewport={"width": 390, "height": 844}, color_scheme="dark")
    opened = context.new_page()
    opened.goto((run / "report.html").as_uri())
    opened.wait_for_selector("html[data-ready=yes]", timeout=120_000)
    assert opened.evaluate("document.documentElement.scrollWidth") == 390
    context.close()


def test_without_scripts_words_tables_and_figures_are_there(browser, run):
    context = browser.new_context(java_script_enabled=False)
    opened = context.new_page()
    opened.goto((run / "report.html").as_uri())
    assert opened.locator("#findings").inner_text().count("Expert (cbf)") >= 2
    assert opened.locator("#tables tbody tr").count() == 8
    assert opened.locator("#figures img").first.is_visible()
    assert not opened.locator("#player").is_visible()
    context.close()
