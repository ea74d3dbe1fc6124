"""
What README and documentation show works as it stands there.

Three things are shortened. Every number from 10 000 on, such as the length of a training, becomes 256; a search has two
trials; and a rollout has 128 steps. Python snippets of a page run in order and share their names; a test among them is run
as well.
"""

import argparse
import json
import re
import runpy
import shlex
import sys
from pathlib import Path
from unittest import mock

import pytest
import yaml
from rl_zoo3.train import train
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm

from sb3_cchain.tensorboard import layout
from sb3_cchain.zoo import __main__ as console
from sb3_cchain.zoo import cli
from tests.extras import NO_WHEELS

ROOT = Path(__file__).parent.parent
PAGES = sorted(
    [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *(ROOT / "docs").glob("[!_]*.md"), *(ROOT / "docs").glob("*/*.md")]
)

# What a page leaves to the reader: a training loop, an environment
GIVEN = {
    "docs/modules/churn.md": """
import torch
network = torch.nn.Linear(2, 3)
optimizer = torch.optim.Adam(network.parameters())
loss_fn = torch.nn.CrossEntropyLoss()
batches = [(torch.randn(8, 2), torch.randint(3, (8,)), torch.randn(8, 2)) for _ in range(3)]
references = (torch.randn(8, 2) for _ in range(100))
def somebody_elses_training_loop(*args):
    for batch, target, _ in batches:
        optimizer.zero_grad()
        loss_fn(network(batch), target).backward()
        optimizer.step()
""",
    "docs/environments.md": "def make_heavier_cartpole(): return __import__('gymnasium').make('CartPole-v1')",
}
# Pages with snippets for DeepMind Control and ProcGen
NEED_WHEELS = ["docs/environments.md"]


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def snippets(page: Path, language: str) -> list[str]:
    """The code blocks of a page in a language; those inside of lists without their indentation."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    return [re.sub(rf"^{indentation}", "", code, flags=re.MULTILINE) for indentation, code in found]


def pages_with(language: str) -> list[Path]:
    return [page for page in PAGES if snippets(page, language)]


def shorten(code: str) -> str:
    return re.sub(r"\bn_trials=\d+", "n_trials=2", re.sub(r"\b\d[\d_]{4,}\b", "256", code))


def test_shortens_large_numbers_and_searches_alone():
    assert shorten("learn(640_000, n_steps=9999), 10000, x_100000, 1e5") == "learn(256, n_steps=9999), 256, x_100000, 1e5"
    assert shorten("optimize(n_trials=20), n=20") == "optimize(n_trials=2), n=20"


@pytest.fixture
def short_rollouts(tmp_path, monkeypatch):
    """Rollouts of 128 steps, in a folder of their own."""
    init = OnPolicyAlgorithm.__init__

    def init_short(self, policy, env, *args, **kwargs):
        n_envs = getattr(env, "num_envs", 1)
        init(self, policy, env, *args, **{**kwargs, "n_steps": max(128 // n_envs, 1)})

    monkeypatch.setattr(OnPolicyAlgorithm, "__init__", init_short)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("page", pages_with("python"), ids=name_of)
def test_python_runs(page, short_rollouts, monkeypatch):
    if NO_WHEELS and name_of(page) in NEED_WHEELS:
        pytest.skip("no wheels")
    # Videos are not encoded
    for name in ("moviepy", "moviepy.video", "moviepy.video.io", "moviepy.video.io.ImageSequenceClip"):
        monkeypatch.setitem(sys.modules, name, mock.MagicMock())
    # The charts that a snippet adds are not for other tests
    monkeypatch.setattr(layout, "LAYOUT", {category: dict(charts) for category, charts in layout.LAYOUT.items()})
    names: dict = {}
    exec(GIVEN.get(name_of(page), ""), names)
    for code in snippets(page, "python"):
        exec(compile(shorten(code), name_of(page), "exec"), names)
    for name in [name for name in names if name.startswith("test_")]:
        names[name]()


NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_notebook_runs(notebook, short_rollouts, monkeypatch):
    plt = pytest.importorskip("matplotlib.pyplot")
    monkeypatch.setattr(plt, "show", lambda: None)
    names: dict = {}
    for cell in json.loads(notebook.read_text())["cells"]:
        if cell["cell_type"] == "code" and "install" not in cell["metadata"].get("tags", []):
            exec(compile(shorten("".join(cell["source"])), name_of(notebook), "exec"), names)
    plt.close("all")


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_notebook_begins_with_the_installation(notebook):
    first = next(cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code")
    assert first["metadata"]["tags"] == ["install"]
    (extras,) = re.findall(r"^    %pip install -q \"sb3-cchain\[([\w,]+)\]\"$", "".join(first["source"]), flags=re.MULTILINE)
    known = re.findall(r"^(\w+) = \[", (ROOT / "pyproject.toml").read_text(), flags=re.MULTILINE)
    assert set(extras.split(",")) <= set(known)


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_notebook_links_lead_somewhere(notebook):
    text = "".join(line for cell in json.loads(notebook.read_text())["cells"] for line in cell["source"])
    for target in re.findall(r"\]\((?!http)([^)#\s]+)", text):
        assert (notebook.parent / target).exists(), target


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=name_of)
def test_notebook_was_run_as_a_whole(notebook):
    cells = [cell for cell in json.loads(notebook.read_text())["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert not any(output["output_type"] == "error" for cell in cells for output in cell["outputs"])


def test_the_quickstart_goes_on_where_the_model_was(short_rollouts):
    names: dict = {}
    *codes, _ = snippets(ROOT / "docs" / "quickstart.md", "python")  # the last one is another training
    for code in codes:
        exec(shorten(code), names)
    assert names["model"].num_timesteps == 512
    assert list(short_rollouts.glob("runs/quickstart/CChainPPO_1/events*")) and (short_rollouts / "acrobot.zip").exists()


YAML = [pytest.param(code, id=f"{name_of(page)}-{i}") for page in PAGES for i, code in enumerate(snippets(page, "yaml"))]


@pytest.mark.parametrize("code", YAML)
def test_yaml_trains_with_the_stock_rl_zoo(code, short_rollouts, monkeypatch):
    settings = yaml.safe_load(code)
    if not all(isinstance(value, dict) for value in settings.values()):  # not entries but a part of one
        settings = {"Continual/Acrobot-v1": {"n_timesteps": 256, "policy": "MlpPolicy", **settings}}
        code = yaml.safe_dump(settings)
    Path("settings.yml").write_text(code)
    for env_id in settings:
        is_dqn = "MinAtar" in env_id
        arguments = [
            *("--algo", "dqn" if is_dqn else "ppo", "--env", env_id, "--gym-packages", "sb3_cchain"),
            *("-conf", "settings.yml", "-f", "logs", "--eval-freq", "-1", "--verbose", "0", "--device", "cpu"),
            *(("-n", "100", "-params", "buffer_size:1000") if is_dqn else ("-n", "128")),
        ]
        monkeypatch.setattr(sys, "argv", ["train", *arguments])
        train()
    assert list(short_rollouts.glob("logs/*/*/*-v*.zip"))


class ParsedError(Exception):
    """The command line was understood."""


COMMANDS = [
    pytest.param(shlex.split(command.rstrip(" &"), comments=True), id=command.split("#")[0].strip())
    for command in sorted(
        {
            line.strip()
            for page in PAGES
            for code in snippets(page, "bash")
            for line in code.replace("\\\n", " ").splitlines()
            if re.match(r"\s*(sb3-cchain|make|\S*python -m (benchmarks|rl_zoo3))\b", line)
        }
    )
]


@pytest.mark.parametrize("command", COMMANDS)
def test_command_is_understood(command, monkeypatch):
    parse_args = argparse.ArgumentParser.parse_args

    def parse_and_stop(self, *args, **kwargs):
        parse_args(self, *args, **kwargs)
        raise ParsedError

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_stop)
    if command[0] == "make":
        targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
        assert {argument for argument in command[1:] if "=" not in argument} <= set(targets)
    elif command[0] == "sb3-cchain":
        monkeypatch.setattr(cli, "find_resumed", lambda *options: options)  # it is not there
        monkeypatch.setattr(sys, "argv", command)
        with pytest.raises(ParsedError):
            console.main()
    else:
        monkeypatch.setattr(sys, "argv", command[2:])
        with pytest.raises(ParsedError):
            runpy.run_module(command[2], run_name="__main__", alter_sys=True)


def without_code(page: Path) -> str:
    return re.sub(r"^ *```.*?^ *```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


def anchors(page: Path) -> set[str]:
    """Those of the headings of a page."""
    titles = re.findall(r"^#+ (.*)$", without_code(page), flags=re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


ALL_PAGES = [*PAGES, ROOT / "CHANGELOG.md"]


@pytest.mark.parametrize("page", ALL_PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", without_code(page)):
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        linked = (page.parent / path).resolve() if path else page
        assert linked.exists(), target
        # The site has the pages of docs/ alone
        assert linked.suffix != ".md" or page.parent == ROOT or (ROOT / "docs") in linked.parents, target
        assert not anchor or anchor in anchors(linked), target


@pytest.mark.parametrize("page", ALL_PAGES, ids=name_of)
def test_lines_are_wrapped(page):
    def may_be_longer(line):
        is_link_alone = re.fullmatch(r"[\W\d]*\[?!?\[[^\]]*\]\([^)]*\)\S*", line)
        return line.startswith(("|", "$$")) or is_link_alone

    lines = map(str.strip, without_code(page).splitlines())
    assert [line for line in lines if len(line) > 120 and not may_be_longer(line)] == []
