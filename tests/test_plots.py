import io
import itertools
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
from matplotlib.text import Text

from benchmarks import labels, plots, stats
from benchmarks.sections import Section
from benchmarks.tables import SummaryRow

VEHICLE, PANDA = "RISE-GroundVehicle-v0", "RISE-SafePanda-v0"


def make_summary(
    envs=(VEHICLE, PANDA), agents=("rise", "pcbc", "cppo"), levels=(0.0, 0.5, 1.0, 2.0), **changes
):
    """Rates that fall with the noise and differ between agents and metrics."""
    summary = []
    for (i, env), (j, agent), level in itertools.product(enumerate(envs), enumerate(agents), levels):
        n = changes.get("episodes", 1000)
        safe = round(n * (1 - 0.1 * level * (1 + 0.5 * i + 0.2 * j)))
        reach = round(safe * 0.95)
        low, high = stats.wilson([safe, reach], n)
        row = {"noise_model": "step", "train_seeds": 1, "episodes": n} | changes
        summary.append(
            SummaryRow(
                **{"env": env, "agent": agent, "noise_level": level} | row,
                safety_rate=safe / n,
                safety_low=low[0],
                safety_high=high[0],
                reach_rate=reach / n,
                reach_low=low[1],
                reach_high=high[1],
                arrival_rate=0.97,
                mean_cost=0.3,
                mean_steps=90.0,
                safety_iqm=safe / n,
                reach_iqm=reach / n,
                clearance_iqm=0.2,
            )
        )
    return summary


def texts(figure):
    """Everything the figure says, with where it stands in pixels."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    found = dict.fromkeys(figure.findobj(lambda artist: isinstance(artist, Text) and artist.get_visible()))
    return [(t.get_text(), t.get_window_extent(canvas.get_renderer())) for t in found if t.get_text().strip()]


def words(figure):
    return "\n".join(text for text, _ in texts(figure))


MANY = ("rise", "pcbc", "cppo", "expert", "random", *(f"rise-belief-variant-{i}" for i in range(7)))
CASES = {
    "two tasks": make_summary(),
    "references": make_summary(agents=("rise", "expert", "random"), train_seeds=5, episodes=5000),
    "one of each": make_summary(envs=(VEHICLE,), agents=("rise",), levels=(1.0,), episodes=7),
    "one level": make_summary(agents=MANY[:5], levels=(1.0,)),
    "many agents": make_summary(agents=MANY),
    "missing": make_summary()[:-2] + make_summary(envs=(VEHICLE,), agents=("expert",)),
    "foreign": make_summary(envs=("parking-v0",), noise_model="step+dropout:0.3"),
    "nothing noisy": make_summary(levels=(0.0,)),
    "long noise": make_summary(
        noise_model="step:0.5@position+episode:0.5@radius+outlier:0.05@velocity+delay:2"
    ),
    "long noise, one task": make_summary(envs=(VEHICLE,), noise_model="step@position+episode:0.5@radius"),
}


@pytest.mark.parametrize("summary", CASES.values(), ids=CASES)
def test_all_words_stand_inside_the_figure_and_apart(summary):
    level = 0.0 if summary == CASES["nothing noisy"] else 1.0
    for figure in (plots.comparison(summary, level), plots.noise_curve(summary)):
        found = texts(figure)
        for text, box in found:
            assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, text
            assert figure.bbox.y0 <= box.y0 and box.y1 <= figure.bbox.y1, text
        for (text, box), (other, other_box) in itertools.combinations(found, 2):
            assert not box.overlaps(other_box), (text, other)


def make_sections(summary):
    """Three groups of other rows, one of them under two noise models."""
    noisy = make_summary(agents=("rise", "rise-belief"), levels=(1.0,), noise_model="drift:0.3")
    noisy += make_summary(agents=("rise", "rise-belief"), levels=(1.0,), noise_model="step@position+delay:5")
    return [
        Section("Is it the encoder?", [row for row in summary if row.agent in ("rise", "pcbc")]),
        Section("Noise of other kinds", noisy),
        Section("Experts", make_summary(agents=("expert", "random"), levels=(0.0, 2.0))),
    ]


@pytest.mark.parametrize("env", [VEHICLE, PANDA])
def test_groups_stand_under_their_titles_with_the_rates_of_their_level(env):
    sections = [
        Section(s.title, [row for row in s.rows if row.env == env]) for s in make_sections(make_summary())
    ]
    figure = plots.grouped(sections)
    found = texts(figure)
    for text, box in found:
        assert figure.bbox.x0 <= box.x0 and box.x1 <= figure.bbox.x1, text
    for (text, box), (other, other_box) in itertools.combinations(found, 2):
        assert not box.overlaps(other_box), (text, other)
    own = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    both = ["", "", "RISE", "RISE-belief"]
    assert own == ["", "RISE", "PC-BC", *both, *both, "", "", "Expert", "Random"]
    titles = {
        text: place for text, place in ((t.get_text(), t.get_position()[1]) for t in figure.axes[0].texts)
    }
    assert {
        text: place for text, place in titles.items() if " " in text.strip(" %") or text == "Experts"
    } == {
        "Is it the encoder?": 0,
        "Noise of other kinds: a drifting error (0.3)": 4,
        "Noise of other kinds: fresh noise at every step, positions only + delayed readings (5)": 8,
        "Experts": 12,
    }
    shown = [
        row for s in sections for row in s.rows if row.noise_level == (2.0 if s.title == "Experts" else 1.0)
    ]
    for panel, key in zip(figure.axes, ("safety", "reach"), strict=True):
        widths = [patch.get_width() for patch in panel.patches]
        assert widths == pytest.approx([100 * getattr(row, f"{key}_rate") for row in shown])


def test_references_are_grey_and_agents_are_not():
    names = ["rise", "mine", "expert-cbf+kalman", "expert-mpc+kalman", "random", "theirs"]
    colours = {name: plots.colour(names, name) for name in names}
    for name, hexadecimal in colours.items():
        red, green, blue = (hexadecimal[i : i + 2] for i in (1, 3, 5))
        assert (red == green == blue) == labels.is_reference(name)
    assert len(set(colours.values())) == len(names)


def test_a_figure_of_no_groups_is_refused():
    with pytest.raises(ValueError, match="no rows to draw"):
        plots.grouped([])


def test_comparison_draws_the_rates_and_intervals_of_its_level():
    summary = make_summary()
    figure = plots.comparison(summary, 0.5)
    panels = iter(figure.axes)
    for env in (VEHICLE, PANDA):
        rows = [row for row in summary if row.env == env and row.noise_level == 0.5]
        for key in ("safety", "reach"):
            panel = next(panels)
            widths = [patch.get_width() for patch in panel.patches]
            assert widths == pytest.approx([100 * getattr(row, f"{key}_rate") for row in rows])
            whiskers = [np.asarray(lines.get_segments()[0])[:, 0] for lines in panel.collections]
            ends = [[100 * getattr(row, f"{key}_{end}") for end in ("low", "high")] for row in rows]
            np.testing.assert_allclose(whiskers, ends)
            for row in rows:
                assert f"{100 * getattr(row, f'{key}_rate'):.1f} %" in [t.get_text() for t in panel.texts]


def test_figures_say_what_they_show():
    said = words(plots.comparison(make_summary(train_seeds=5, episodes=5000), 1.0))
    for part in (
        "Ground vehicle: Safety Rate",
        "Franka Panda: Reach Rate",
        "Noise level 1 (fresh noise at every step)",
        "5,000 episodes per bar of 5 training seeds",
        "95 % intervals",
        "goal reached, no collision",
        "PC-BC",
    ):
        assert part in said
    single = words(plots.comparison(make_summary(), 0.0))
    assert "clean readings" in single and "95 % intervals" in single


def test_noise_curve_draws_every_rate():
    summary = make_summary(agents=("rise", "pcbc"))
    lines = [panel.get_lines() for panel in plots.noise_curve(summary).axes]
    for panel, (env, key) in zip(
        lines, itertools.product((VEHICLE, PANDA), ("safety", "reach")), strict=True
    ):
        for line, agent in zip(panel, ("rise", "pcbc"), strict=True):
            rows = [row for row in summary if (row.env, row.agent) == (env, agent)]
            np.testing.assert_allclose(line.get_xdata(), [0, 0.5, 1, 2])
            np.testing.assert_allclose(line.get_ydata(), [100 * getattr(row, f"{key}_rate") for row in rows])
    bands = plots.noise_curve(summary).axes[0].collections
    corners = bands[0].get_paths()[0].vertices
    first = [row for row in summary if (row.env, row.agent) == (VEHICLE, "rise")][-1]
    at_last = corners[corners[:, 0] == 2.0, 1]
    assert (at_last.min(), at_last.max()) == pytest.approx((100 * first.safety_low, 100 * first.safety_high))


def test_what_was_not_run_is_said():
    summary = [row for row in make_summary() if (row.env, row.agent) != (PANDA, "cppo")]
    assert words(plots.comparison(summary, 1.0)).count("not run") == 2
    only_clean = [row for row in summary if row.env == VEHICLE or row.noise_level == 0]
    assert words(plots.comparison(only_clean, 1.0)).count("not run") == 6


def test_requests_that_make_no_sense_say_why():
    with pytest.raises(ValueError, match=r"level 3; measured were 0, 0\.5, 1, 2"):
        plots.comparison(make_summary(), 3.0)
    two = make_summary() + make_summary(noise_model="episode", agents=("rise",))
    for draw in (lambda **kw: plots.comparison(two, 1.0, **kw), lambda **kw: plots.noise_curve(two, **kw)):
        with pytest.raises(ValueError, match="noise models episode, step: choose one"):
            draw()
        assert "one constant error per episode" in words(draw(noise_model="episode"))
    with pytest.raises(ValueError, match="no episodes"):
        plots.noise_curve([])


def test_level_0_that_was_measured_once_is_in_the_curve_of_every_model():
    """As a run of several noise models measures it: under the first."""
    first = make_summary(agents=("rise", "pcbc"))
    second = [row for row in make_summary(noise_model="episode", agents=("rise", "pcbc")) if row.noise_level]
    alone = make_summary(noise_model="episode", agents=("rise", "pcbc"))

    def drawn(summary, model):
        axes = plots.noise_curve(summary, model).axes
        return [sorted(line.get_xydata().tolist() for line in axis.lines) for axis in axes]

    assert drawn(first + second, "episode") == drawn(alone, "episode")
    assert drawn(first + second, "step") == drawn(first, "step")
    assert drawn(first + alone, "episode") == drawn(alone, "episode")  # nothing twice where both have it


def test_agents_keep_their_colours_whatever_is_shown_beside_them():
    everyone = [plots.colour(MANY, agent) for agent in MANY[:6]]
    assert len(set(everyone)) == 6
    assert [plots.colour((agent,), agent) for agent in MANY[:6]] == everyone
    for agent in ("expert", "random"):  # greys
        assert len(set(plots.colour(MANY, agent)[i : i + 2] for i in (1, 3, 5))) == 1


def test_saved_pictures_are_reproducible_and_carry_no_time(tmp_path):
    for name in "ab":
        plots.save_png(plots.comparison(make_summary(), 1.0), tmp_path / f"{name}.png")
    content = (tmp_path / "a.png").read_bytes()
    assert content == (tmp_path / "b.png").read_bytes()
    assert b"tEXt" not in content and b"tIME" not in content
    assert imread(io.BytesIO(content)).shape[1] == 1600


def test_plotting_never_loads_pyplot():
    code = "import sys, benchmarks.plots; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    "rate, text",
    [
        (0, "0.0"),
        (1, "100.0"),
        (0.859, "85.9"),
        (0.9998, "99.98"),
        (0.0004, "0.04"),
        (0.999999, "99.99"),
        (1e-9, "0.01"),
    ],
)
def test_percentages_never_hide_the_last_episode(rate, text):
    assert labels.percent(rate) == text


def test_labels_read_as_words():
    assert labels.env_label("RISE-GroundVehicle-v0") == "Ground vehicle"
    assert labels.env_label("RISE-MobileArmReach-v3") == "Mobile arm reach"
    assert labels.env_label("parking-v0") == "parking-v0"
    assert [labels.agent_label(name) for name in ("rise", "pcbc", "cppo", "mine")] == [
        "RISE",
        "PC-BC",
        "C-PPO",
        "mine",
    ]
    assert (
        labels.noise_label("step+delay:2+mine:3")
        == "fresh noise at every step + delayed readings (2) + mine (3)"
    )
    assert labels.noise_label("episode@position") == "one constant error per episode, positions only"
    assert (
        labels.noise_label("delay:2@radius + mine@hand")
        == "delayed readings (2), radii only + mine, hand only"
    )
    assert labels.noise_label("outlier:0.1") == "fresh noise with outliers (0.1)"
    assert labels.count([1], "episode") == "1 episode"
    assert labels.count([2000, 500, 2000], "episode") == "500–2,000 episodes"
