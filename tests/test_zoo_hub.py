"""The commands for the Hugging Face Hub, with a folder in the place of the hub."""

import shutil
from importlib import import_module
from pathlib import Path

import gymnasium as gym
import huggingface_hub
import numpy as np
import pytest
import torch as th
import yaml
from huggingface_hub.utils import EntryNotFoundError

from sb3_cchain import CChainDQN, CChainPPO
from tests.zoo_command import FAST, NO_EVALUATION, SHORT_PPO, command

SHORT_DQN = ("-params", "buffer_size:100", "learning_starts:10", "callback:'sb3_cchain.TaskSync'", "policy:'MlpPolicy'")


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """A folder that the client pushes to and loads from."""
    folder = tmp_path / "the hub"

    class Client:
        """In the place of the client, with the calls that the commands make."""

        def __init__(self, token=None):
            pass

        def create_repo(self, repo_id, token=None, private=False, exist_ok=False):
            (folder / repo_id).mkdir(parents=True, exist_ok=exist_ok)
            return f"hub/{repo_id}"

        def snapshot_download(self, repo_id, local_dir):
            shutil.copytree(folder / repo_id, local_dir, dirs_exist_ok=True)

        def upload_folder(self, repo_id, folder_path, commit_message):
            assert commit_message
            shutil.copytree(folder_path, folder / repo_id, dirs_exist_ok=True)

    def download(repo_id, filename, **kwargs):
        path = folder / repo_id / filename
        if not path.is_file():
            raise EntryNotFoundError(f"{filename} is not in {repo_id}")
        return str(path)

    monkeypatch.setattr(huggingface_hub, "HfApi", Client)
    monkeypatch.setattr(huggingface_hub, "hf_hub_download", download)
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    monkeypatch.chdir(tmp_path)
    return folder


CASES = {
    "ppo_cchain": (CChainPPO, SHORT_PPO),
    "dqn_cchain": (CChainDQN, SHORT_DQN),
    "normalised": (CChainPPO, (*SHORT_PPO, "normalize:True")),
}


@pytest.mark.parametrize("case", CASES)
def test_a_model_comes_back_from_the_hub(case, hub, capsys):
    cls, settings = CASES[case]
    algo = "dqn_cchain" if cls is CChainDQN else "ppo_cchain"
    of = ("--algo", algo, "--env", "Continual/CartPole-v1")
    tasks = ("--env-kwargs", "n_tasks:2", "steps_per_task:40")
    command("train", *of, "-n", "64", *tasks, "-f", "logs", "--seed", "0", *FAST, *NO_EVALUATION, *settings)
    command("push_to_hub", *of, "-f", "logs", "-orga", "me", "-n", "20", "--no-render", "--verbose", "0", "--device", "cpu")
    pushed = hub / "me" / f"{algo}-Continual-CartPole-v1"
    assert (pushed / "vec_normalize.pkl").exists() == (case == "normalised")
    assert yaml.safe_load((pushed / "env_kwargs.yml").read_text()) == {"n_tasks": 2, "steps_per_task": 40}

    command("load_from_hub", *of, "-f", "loaded", "-orga", "me")
    name, folder = "Continual-CartPole-v1", Path(algo, "Continual-CartPole-v1_1")
    trained, loaded = (cls.load(Path(logs, folder, f"{name}.zip"), device="cpu") for logs in ("logs", "loaded"))
    for before, after in zip(trained.policy.parameters(), loaded.policy.parameters(), strict=True):
        assert th.equal(before, after)
    assert loaded.num_timesteps == trained.num_timesteps == 64
    config, loaded_config = (Path(logs, folder, name, "config.yml").read_text() for logs in ("logs", "loaded"))
    assert loaded_config == config

    capsys.readouterr()
    returns = []
    for logs in ("logs", "loaded"):
        command("enjoy", *of, "-f", logs, "-n", "120", "--no-render", "--device", "cpu", "--num-threads", "1")
        output = capsys.readouterr().out
        returns.append([line for line in output.splitlines() if line.startswith("Episode Reward")])
    assert returns[0] == returns[1] != []


def test_the_model_card_names_our_commands(hub):
    of = ("--algo", "ppo_cchain", "--env", "Continual/CartPole-v1")
    command("train", *of, "-n", "32", "-f", "logs", *FAST, *NO_EVALUATION, *SHORT_PPO)
    command("push_to_hub", *of, "-f", "logs", "-orga", "me", "--no-render", "--device", "cpu")
    card = (hub / "me" / "ppo_cchain-Continual-CartPole-v1" / "README.md").read_text()
    assert "**CChainPPO** Agent playing **Continual/CartPole-v1**" in card
    assert "\nsb3-cchain load_from_hub --algo ppo_cchain --env Continual/CartPole-v1 -orga me -f logs/\n" in card
    assert "rl_zoo3" not in card and '\npip install ".[zoo]"\n' in card
    assert "https://arxiv.org/abs/2506.00592" in card
    metadata = yaml.safe_load(card.split("---")[1])
    assert metadata["library_name"] == "stable-baselines3" and "Continual/CartPole-v1" in metadata["tags"]
    (result,) = metadata["model-index"]
    assert result["name"] == "CChainPPO" and np.isfinite(float(result["results"][0]["metrics"][0]["value"].split()[0]))


def test_the_model_card_says_what_was_evaluated(hub, monkeypatch):
    of = ("--algo", "ppo_cchain", "--env", "Continual/CartPole-v1")
    command("train", *of, "-n", "32", "-f", "logs", *FAST, *NO_EVALUATION, *SHORT_PPO)
    evaluated = []
    push = import_module("huggingface_sb3.push_to_hub")  # the function of that name hides the module
    monkeypatch.setattr(push, "_evaluate_agent", lambda _, env, *args: evaluated.append(env.get_attr("task_id")) or (1, 0))
    options = ("-f", "logs", "-orga", "me", "--no-render", "--device", "cpu")
    command("push_to_hub", *of, *options)
    command("push_to_hub", *of, *options, "--env-kwargs", "first_task:9")
    assert evaluated == [[0], [9]]
    card = (hub / "me" / "ppo_cchain-Continual-CartPole-v1" / "README.md").read_text()
    assert "{'first_task': 9}" in card and "the one that `first_task`" in card


def test_an_environment_of_ones_own(hub, tmp_path, monkeypatch):
    (tmp_path / "grid_of_a_user.py").write_text(
        "import gymnasium as gym\n\n"
        "gym.register('MyGrid-v0', 'gymnasium.envs.classic_control:CartPoleEnv', max_episode_steps=9)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    gym.register("MyGrid-v0", "gymnasium.envs.classic_control:CartPoleEnv", max_episode_steps=9)
    of = ("--algo", "ppo_cchain", "--env", "MyGrid-v0")
    (tmp_path / "own.yml").write_text("MyGrid-v0:\n  policy: MlpPolicy\n  n_timesteps: 32\n")
    command("train", *of, "-conf", "own.yml", "-f", "logs", *FAST, *NO_EVALUATION, *SHORT_PPO)
    # As in the new process of another command
    monkeypatch.delitem(gym.registry, "MyGrid-v0")
    packages = ("--gym-packages", "grid_of_a_user")
    command("push_to_hub", *of, *packages, "-f", "logs", "-orga", "me", "--no-render", "--device", "cpu")
    card = (hub / "me" / "ppo_cchain-MyGrid-v0" / "README.md").read_text()
    assert "\nsb3-cchain enjoy --algo ppo_cchain --env MyGrid-v0  -f logs/ --gym-packages grid_of_a_user\n" in card
    command("load_from_hub", *of, "-f", "loaded", "-orga", "me", *packages)
    assert Path("loaded", "ppo_cchain", "MyGrid-v0_1", "MyGrid-v0.zip").is_file()


def test_loading_needs_trust(hub, monkeypatch):
    monkeypatch.delenv("TRUST_REMOTE_CODE")
    with pytest.raises(ValueError, match="TRUST_REMOTE_CODE"):
        command("load_from_hub", "--algo", "ppo_cchain", "--env", "CartPole-v1", "-f", "loaded", "-orga", "me")


@pytest.mark.parametrize("name", ["load_from_hub", "push_to_hub"])
def test_the_hub_commands_know_our_names(name, capsys):
    with pytest.raises(SystemExit) as exit_info:
        command(name, "--help")
    assert exit_info.value.code == 0
    output = capsys.readouterr().out
    assert "dqn_cchain" in output and "--gym-packages" in output
