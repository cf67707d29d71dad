"""Pages that follow from registries and docstrings; a line in a registry is all that a new one needs.

Each function gives pages by their path in ``docs/reference``; :func:`write` puts all of them there.
"""

from __future__ import annotations

import inspect
import io
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from docstring_parser import DocstringStyle, parse
from gymnasium import spaces

from benchmarks.configs import SHIPPED, read
from benchmarks.pages import markdown_table
from rise_agents import AGENTS, agent_class, pretrained
from rise_agents.agent import acting_settings
from rise_agents.experts import EXPERTS, expert_names
from rise_agents.filters import FILTERS
from rise_envs import ENVS, NOISE_MODELS, STAND_INS, make_noise
from rise_envs.noise import corrupt
from rise_envs.registry import find_class
from rise_envs.task import describes_task, env_class, task_of

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent
FOLDER = "reference"  # below docs; made by every build
PACKAGES = ("rise_envs", "rise_agents", "benchmarks")
BESIDE = {  # pages that stand beside ``docs``: what they are on the site
    "README.md": "index",
    "CONTRIBUTING.md": f"{FOLDER}/contributing",
    "CHANGELOG.md": f"{FOLDER}/changelog",
    "SECURITY.md": f"{FOLDER}/security",
}

_LINK = re.compile(r"\[([^\]]*)\]\(([^)\s]+\.py)\)")
_IMPORT = re.compile(
    r"^(?:from|import) ((?:rise_envs|rise_agents|benchmarks)[\w.]*)(?: import ([\w, ]+))?", re.M
)


# --- pieces of pages -------------------------------------------------------------------------------------------


def first_line(thing: Any) -> str:
    """The first paragraph of a docstring, in one line."""
    return " ".join((inspect.getdoc(thing) or "").partition("\n\n")[0].split())


def in_markdown(text: str, module: str = "") -> str:
    """Text of a module's docstring with the roles of reStructuredText as MyST writes them."""
    text = re.sub(
        r"(?<!:)(?<!\w):(\w+):`(\w+)`", rf"{{py:\1}}`\2 <{module}.\2>`", text
    )  # names of the module
    text = re.sub(r"(?<!:)(?<!\w):(\w+):`", r"{py:\1}`", text)
    return re.sub(r"``([^`]+)``", r"`\1`", text)


def rst(text: str, module: str) -> str:
    """A block of reStructuredText whose names are those of ``module``."""
    return f"```{{eval-rst}}\n.. py:currentmodule:: {module}\n\n{text.strip()}\n```"


def table(header: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A Markdown table; bars within cells are escaped."""
    cells = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return markdown_table(header, ["---"] * len(header), cells)


def helps(kind: Any) -> dict[str, str]:
    """What the docstrings of a dataclass and of its bases say of each field."""
    said: dict[str, str] = {}
    for base in reversed(kind.__mro__):
        for each in parse(base.__doc__ or "", DocstringStyle.GOOGLE).params:
            said[each.arg_name] = in_markdown(" ".join((each.description or "").split()), base.__module__)
    return said


def settings(kind: Any) -> str:
    """The table of a dataclass's fields: name, default, what for."""
    said = helps(kind)
    rows = [(f"`{name}`", f"`{value(default)}`", said.get(name, "")) for name, default in defaults(kind)]
    return table(("setting", "default", ""), rows)


def defaults(kind: Any) -> list[tuple[str, Any]]:
    """Fields of a dataclass, with their defaults."""
    return [
        (f.name, f.default if f.default_factory is MISSING else f.default_factory()) for f in fields(kind)
    ]


def value(given: Any) -> str:
    """A setting as it is written in Python; floats without noise."""
    if isinstance(given, float):
        return f"{given:.6g}"
    if isinstance(given, tuple):
        return f"({', '.join(map(value, given))}{',' if len(given) == 1 else ''})"
    return repr(given)


def link(entry: str) -> str:
    """A link to the class that ``module:Class`` names."""
    return f"{{py:obj}}`{entry.rpartition(':')[2]} <{entry.replace(':', '.')}>`"


def picture(folder: str, name: str, words: str) -> str:
    """The image of something, if ``pictures.py`` has made one."""
    there = HERE / "images" / folder / f"{name}.gif"
    return f"![{words}](/images/{folder}/{name}.gif)" if there.exists() else ""


def page(*parts: str) -> str:
    """Parts of a page, empty ones left out, a blank line between."""
    return "\n\n".join(part for part in parts if part) + "\n"


def toctree(entries: Iterable[str]) -> str:
    """The pages below this one, for the side bar."""
    return "\n".join(("```{toctree}", ":hidden:", "", *entries, "```"))


# --- environments ----------------------------------------------------------------------------------------------


def entries() -> Iterator[tuple[str, str]]:
    """Environments and their classes, as ``module:Class``."""
    for env_id, (entry, _, _) in ENVS.items():
        yield env_id, entry


def environments() -> dict[str, str]:
    """The page of each environment, and one that shows all."""
    pages = {f"environments/{env_id}.md": environment(env_id) for env_id in ENVS}
    parts = []
    for env_id in ENVS:
        kind = env_class(env_id)
        parts += [
            f"## [{env_id}](environments/{env_id}.md)",
            in_markdown(first_line(kind)),
            env_picture(env_id),
        ]
    guide = "All of these, side by side, and how they are used: [the guide](../environments.md)."
    tree = toctree(f"environments/{env_id}" for env_id in ENVS)
    return pages | {"environments.md": page("# All environments", guide, *parts, tree)}


def env_picture(env_id: str) -> str:
    """An episode of the environment or, of a stand-in that draws nothing, of what it models."""
    own = picture("envs", env_id, f"An expert in {env_id}")
    if own:
        return f"{own}\n\n*An expert at noise level 1; dashed, or translucent: the obstacle as it is read.*"
    if env_id not in STAND_INS:
        return ""
    modelled = STAND_INS[env_id]
    there = picture("envs", modelled, f"An expert in {modelled}")
    return f"{there}\n\n*Drawn by {modelled}, which it models.*" if there else ""


def environment(env_id: str) -> str:
    """The page of an environment: numbers that follow from it, then its docstring."""
    kind, text = env_class(env_id), inspect.getdoc(env_class(env_id)) or ""
    summary, _, rest = text.partition("\n\n")
    markdown = "## " in rest
    body = in_markdown(rest) if markdown else rst(rest, kind.__module__)
    make = f'```python\nimport gymnasium as gym\nimport rise_envs\n\nenv = gym.make("{env_id}")\n```'
    facts = table(("", ""), env_facts(env_id))
    params = inspect.signature(kind).parameters.get("params")
    constants = ""
    if params is not None and is_dataclass(params.default):
        constants = f"## Constants\n\nFields of `params`.\n\n{settings(type(params.default))}"
    return page(f"# {env_id}", in_markdown(summary), env_picture(env_id), make, facts, body, constants)


def env_facts(env_id: str) -> list[tuple[str, str]]:
    """What can be read off an environment itself."""
    (entry, vector, steps), env = ENVS[env_id], env_class(env_id)()
    facts = [("class", link(entry)), ("steps per episode", str(steps))]
    if env_id in STAND_INS:
        facts.append(("stands in for", f"[{STAND_INS[env_id]}]({STAND_INS[env_id]}.md), to train in"))
    if describes_task(env_id):
        task = task_of(env_id)
        facts += [("time step", f"{task.dt:g} s"), ("reached within", f"{task.goal_radius:g} m")]
    facts += [("action", space(env.action_space))]
    inner = env.observation_space
    parts = inner.items() if isinstance(inner, spaces.Dict) else [("observation", inner)]
    facts += [(f"`{key}`", space(each)) for key, each in parts]
    for key, scale in getattr(env, "noise_scale", {}).items():
        facts.append((f"noise of `{key}` at level 1", numbers(scale)))
    for key, groups in getattr(env, "noise_channels", {}).items():
        named = "; ".join(f"`@{name}` {', '.join(map(str, at))}" for name, at in groups.items())
        facts.append((f"channels of `{key}`", named))
    facts.append(("batched form", link(vector) if vector else "Gymnasium's `sync` or `async`"))
    facts.append(("`render_mode`", ", ".join(f"`{mode}`" for mode in env.metadata["render_modes"]) or "none"))
    if any(name == STAND_INS.get(env_id, env_id) for name, _ in EXPERTS):
        facts.append(("[experts](../experts.md)", ", ".join(f"`{name}`" for name in expert_names(env_id))))
    env.close()
    return facts


def space(given: Any) -> str:
    """A space in words."""
    if not isinstance(given, spaces.Box):
        return f"`{given}`"
    return f"{given.shape}, {given.dtype}, from {numbers(given.low)} to {numbers(given.high)}"


def numbers(given: Any) -> str:
    """An array as a short list; one number where all are the same."""
    flat = np.asarray(given).ravel()
    texts = [f"{x:.4g}".replace("-", "−").replace("inf", "∞") for x in flat]
    return texts[0] if len(set(texts)) == 1 else f"[{', '.join(texts)}]"


# --- agents ----------------------------------------------------------------------------------------------------


def agents() -> dict[str, str]:
    """The page of each agent, and one that lists all."""
    pages = {f"agents/{name}.md": agent(name) for name in AGENTS}
    rows = [
        (f"[`{name}`](agents/{name}.md)", first_sentence(agent_class(name)), agent_class(name).learns_from)
        for name in AGENTS
    ]
    guide = "How they are trained, stored and called: [the guide](../agents.md)."
    tree = toctree(f"agents/{name}" for name in AGENTS)
    return pages | {"agents.md": page("# All agents", guide, table(("agent", "", "learns from"), rows), tree)}


def first_sentence(kind: Any) -> str:
    """What an agent is: the first line of its class or, where that says little, of its module."""
    return in_markdown(first_line(inspect.getmodule(kind)) or first_line(kind), kind.__module__)


def agent(name: str) -> str:
    """The page of an agent: how it is made, its settings, and what its module says."""
    kind = agent_class(name)
    module = inspect.getmodule(kind)
    said = inspect.getdoc(module) or inspect.getdoc(kind) or ""
    shown = [picture("agents", f"{name}-{env_id}", f"{name} in {env_id}") for env_id in ENVS]
    if any(shown):
        words = "of those that it ends safely at its goal: an illustration, no result"
        shown.append(f"\n*The first validation scenario at noise level 1, {words}.*")
    first = next((env_id for env_id in ENVS if env_id not in STAND_INS), "")
    make = f'```python\nfrom rise_agents import make_agent\n\nagent = make_agent("{name}", "{first}")\n```'
    judged = "its one or mean action" if kind.evaluate_deterministic else "what it draws in every step"
    facts = [
        ("class", link(AGENTS[name])),
        ("learns from", kind.learns_from),
        ("acts, in the benchmark, with", judged),
    ]
    if acting := acting_settings(kind):
        facts.append(("can be set after training", ", ".join(f"`{each}`" for each in sorted(acting))))
    facts += [(f"defaults in {env_id}", pairs(given)) for env_id, given in kind.PRESETS.items()]
    facts.append(("in preset `smoke`", pairs(kind.BRIEF) or "the same"))
    facts += [
        ("[trained](../../agents.md#trained-agents)", f'`load_agent("{name}", env="{env_id}")`')
        for known, env_id in pretrained.available()
        if known == name
    ]
    found = read([SHIPPED]).variants
    if mine := [f"`{each}`" for each, variant in found.items() if variant.agent == name]:
        facts.append(("[variants](../../benchmark.md#variants)", ", ".join(mine)))
    return page(
        f"# {name}",
        "\n".join(filter(None, shown)),
        rst(said, kind.__module__),
        make,
        table(("", ""), facts),
        "## Settings",
        settings(kind.Config),
    )


def pairs(given: Mapping[str, Any]) -> str:
    """Settings in a line."""
    return ", ".join(f"`{key}` {value(each)}" for key, each in given.items())


def experts() -> dict[str, str]:
    """The page of experts and filters."""
    rows = [(f"`{env_id}`", f"`{name}`", link(entry)) for (env_id, name), entry in EXPERTS.items()]
    parts = [
        "# Experts and filters",
        "[The guide](../agents.md#experts) says how they are used.",
        "## Experts",
    ]
    parts += [table(("environment", "expert", "class"), rows), *classes(EXPERTS.values())]
    parts += ["## Filters", table(("filter", "class"), [(f"`{n}`", link(e)) for n, e in FILTERS.items()])]
    return {"experts.md": page(*parts, *classes(FILTERS.values()))}


def classes(entries: Iterable[str]) -> Iterator[str]:
    """A section for each class: what its module says."""
    for entry in dict.fromkeys(entries):
        kind = find_class(entry)
        yield f"### {kind.__name__}"
        yield rst(inspect.getdoc(inspect.getmodule(kind)) or inspect.getdoc(kind) or "", kind.__module__)


# --- noise -----------------------------------------------------------------------------------------------------


def noise() -> dict[str, str | bytes]:
    """The page of the noise models, and a picture of each."""
    rows = []
    for name, kind in NOISE_MODELS.items():
        said = helps(kind)
        given = [f"`{name}` = {value(default)}: {said.get(name, '')}" for name, default in defaults(kind)]
        entry = f"{kind.__module__}:{kind.__qualname__}"
        rows.append(
            (f"`{name}`", link(entry), in_markdown(first_line(kind), kind.__module__), "; ".join(given))
        )
    about = "How they are written, added up and limited to some channels: [the guide](../noise.md)."
    words = "A reading that moves (line) and what each model makes of it (dots), noise_scale 1"
    text = page(
        "# All noise models",
        about,
        table(("name", "class", "", "parameters"), rows),
        f"![{words}](noise.png)",
    )
    return {"noise.md": text, "noise.png": noise_picture()}


def noise_picture(steps: int = 60) -> bytes:
    """A panel for each noise model: one reading over time, true and noisy."""
    from matplotlib.figure import Figure

    true = 4 * np.sin(np.linspace(0, 12, steps))
    across = 2
    down = -(-len(NOISE_MODELS) // across)
    figure = Figure(figsize=(8, 1.6 * down), layout="constrained")
    panels = figure.subplots(down, across, sharex=True, sharey=True, squeeze=False).ravel()
    for panel, name in zip(panels, NOISE_MODELS, strict=False):
        noisy = corrupt(make_noise(name), true[None, :, None], 1.0, np.array([7], np.uint64))[0, :, 0]
        panel.plot(true, color="#57606a", linewidth=1)
        panel.plot(noisy, ".", color="#c1121f", markersize=4)
        panel.set_title(name, fontsize=10, loc="left")
        panel.set_ylim(-9, 9)
    for panel in panels[len(NOISE_MODELS) :]:
        panel.set_visible(False)
    sink = io.BytesIO()
    figure.savefig(sink, format="png", dpi=120)
    return sink.getvalue()


# --- API -------------------------------------------------------------------------------------------------------


def module_of(path: Path) -> str:
    """The module that a file of this repository is; empty: none."""
    if path.suffix != ".py" or not path.is_relative_to(ROOT):
        return ""
    name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    return name if name.partition(".")[0] in PACKAGES else ""


def texts() -> Iterator[tuple[Path, str]]:
    """All pages that are written by hand."""
    for path in [ROOT / "README.md", *sorted(HERE.rglob("*.md"))]:
        if FOLDER not in path.relative_to(ROOT).parts:
            yield path, path.read_text()


def api_modules() -> dict[str, set[str]]:
    """The modules of the API with the private names of each that pages speak of.

    It has the packages, what they hand on, and every module that a page links to or a snippet imports.
    """
    known: dict[str, set[str]] = {name: set() for name in PACKAGES}
    for path, text in texts():
        for words, target in _LINK.findall(text):
            if name := module_of((path.parent / target).resolve()):
                private = [part for part in words.strip("`").split(".") if part.startswith("_")]
                known.setdefault(name, set()).update(private)
        for name, members in _IMPORT.findall(text):
            for module in (name, *(f"{name}.{member.strip()}" for member in members.split(","))):
                if is_module(module):
                    known.setdefault(module, set())
    registered = [entry for _, entry in entries()] + [e[1] for e in ENVS.values() if e[1]]
    registered += [*AGENTS.values(), *EXPERTS.values(), *FILTERS.values()]
    handed = [home for name in list(known) for home in handed_on(name).values()]
    for module in [*handed, *(entry.partition(":")[0] for entry in registered)]:
        if module.partition(".")[0] in PACKAGES:
            known.setdefault(module, set())
    return dict(sorted(known.items()))


def is_module(name: str) -> bool:
    """Whether ``name`` is a module of this project that can be imported."""
    try:
        return bool(import_module(name).__file__)
    except ImportError:
        return False


def handed_on(module: str) -> dict[str, str]:
    """Names that a package offers and other modules of this project define: where they come from."""
    found, names = import_module(module), {}
    for name in getattr(found, "__all__", ()):
        home = getattr(getattr(found, name), "__module__", module)
        if home != module and home.partition(".")[0] in PACKAGES:
            names[name] = home
    return names


def api() -> dict[str, str]:
    """A page for each module of the API, and one that lists them."""
    known = api_modules()
    parts = ["# API", "Modules that are imported from, or that a page speaks of. `[source]` shows the code."]
    for package in PACKAGES:
        mine = [name for name in known if name.partition(".")[0] == package]
        rows = [
            (f"[`{name}`](api/{name}.md)", in_markdown(first_line(import_module(name)), name))
            for name in mine
        ]
        parts += [f"## {package}", table(("module", ""), rows)]
    return {f"api/{name}.md": module_page(name, private) for name, private in known.items()} | {
        "api.md": page(*parts)
    }


def module_page(name: str, private: Iterable[str] = ()) -> str:
    """The page of a module."""
    lines = [f".. automodule:: {name}", "   :members:", "   :ignore-module-all:", "   :show-inheritance:"]
    if private:
        lines.append(f"   :private-members: {', '.join(sorted(private))}")
    handed = [(f"`{each}`", link(f"{home}:{each}")) for each, home in handed_on(name).items()]
    more = f"Also importable from here:\n\n{table(('name', 'defined as'), handed)}" if handed else ""
    block = "```{eval-rst}\n" + "\n".join(lines) + "\n```"
    return page("---\norphan: true\n---", "[API](../api.md)", f"# {name}", block, more)


# --- other pages -----------------------------------------------------------------------------------------------

_OWN, _CLUSTER = "Bring it along with `--import`: [how](../../own.md).", "[How to use it](../../cluster.md)."
_LANGUAGES = {
    ".py": ("python", _OWN),
    ".sh": ("bash", _CLUSTER),
    ".yaml": ("yaml", _CLUSTER),
    "": ("docker", _CLUSTER),
}  # of examples, by suffix, and what leads back


def beside() -> dict[str, str]:
    """Pages that stand beside ``docs``, and the examples."""
    pages = {
        f"{Path(place).name}.md": f"```{{include}} ../../{name}\n:relative-docs: docs/\n:relative-images:\n```\n"
        for name, place in BESIDE.items()
        if place.startswith(FOLDER)
    }
    for path in sorted((HERE / "examples").iterdir()):
        if path.is_file() and path.suffix in _LANGUAGES:
            language, back = _LANGUAGES[path.suffix]
            code = f"```{{literalinclude}} ../../examples/{path.name}\n:language: {language}\n```"
            pages[f"examples/{path.stem}.md"] = page("---\norphan: true\n---", f"# {path.name}", back, code)
    return pages


def write(folder: Path) -> None:
    """Write all pages; what has not changed is left as it is, what is no page any more is removed."""
    pages: dict[str, str | bytes] = {
        **environments(),
        **agents(),
        **experts(),
        **noise(),
        **api(),
        **beside(),
    }
    for path in folder.rglob("*.*"):
        if path.relative_to(folder).as_posix() not in pages:
            path.unlink()
    for name, content in pages.items():
        path, data = folder / name, content.encode() if isinstance(content, str) else content
        if not path.exists() or path.read_bytes() != data:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
