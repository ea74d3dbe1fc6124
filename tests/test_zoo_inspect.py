"""``sb3-cchain inspect``: one line where a file cannot be inspected, before the work starts; findings, and exit codes."""

import json
import os
import re
import zipfile

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from sb3_contrib import MaskablePPO
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3 import A2C, DQN, PPO
from stable_baselines3.common.save_util import save_to_zip_file
from stable_baselines3.common.vec_env import VecNormalize

import sb3_cchain.zoo.inspect
from sb3_cchain import CChainPPO
from sb3_cchain.analysis.findings import diagnose
from sb3_cchain.analysis.inspection import Inspection, inspect_model
from tests.zoo_command import FAST, NO_EVALUATION, SHORT_PPO, command


def make(algorithm=PPO, **kwargs):
    settings = dict(buffer_size=50) if algorithm is DQN else dict(n_steps=8)
    if algorithm in (PPO, CChainPPO):
        settings.update(batch_size=8, n_epochs=1)
    return algorithm("MlpPolicy", "CartPole-v1", policy_kwargs=dict(net_arch=[4]), seed=0, device="cpu", **settings)


@pytest.fixture(autouse=True)
def no_work(monkeypatch):
    """Errors come before it."""
    monkeypatch.setattr(sb3_cchain.zoo.inspect, "inspect_model", lambda *_: pytest.fail("work started"))


def error_of(capsys, *arguments):
    """The one line that the command ends with."""
    with pytest.raises(SystemExit) as exit_info:
        command("inspect", *arguments, "--env", "CartPole-v1", "--device", "cpu")
    assert exit_info.value.code == 2
    usage, line = capsys.readouterr().err.rstrip("\n").split("sb3-cchain inspect: error: ")
    assert (not usage or usage.startswith("usage")) and "\n" not in line
    return line


def without_data(path):
    save_to_zip_file(path, params=make().get_parameters())


def torn(path):
    make().save(path)
    path.write_bytes(path.read_bytes()[:-200])


def of_other_shapes(path):
    model = make()
    model.policy_kwargs = dict(net_arch=[5])
    model.save(path)


def of_lost_class(path):
    """Of an algorithm whose code is gone."""
    model = make()
    model.save(path)
    data = json.loads(zipfile.ZipFile(path).read("data"))
    data["policy_class"][":serialized:"] = "bm9uZQ=="
    save_to_zip_file(path, params=model.get_parameters())
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("data", json.dumps(data))


@pytest.mark.parametrize(
    "write, message",
    [
        (without_data, "without the model's settings (no entry `data`): save it by the model's save()"),
        (torn, "is torn or not a saved model"),
        (lambda path: path.write_text("no zip"), "is torn or not a saved model"),
        (of_lost_class, "cannot be read"),
        (of_other_shapes, "cannot be loaded as PPO: RuntimeError('Error(s) in loading state_dict"),
    ],
)
def test_what_is_no_model_that_can_be_inspected(write, message, tmp_path, capsys):
    write(tmp_path / "model.zip")
    line = error_of(capsys, tmp_path / "model.zip", "--output", tmp_path / "output")
    assert line.startswith(f"{tmp_path / 'model.zip'} in CartPole-v1: ") and message in line


@pytest.mark.parametrize(
    "saved_by, algo, message",
    [
        (DQN, "ppo", "it was not saved by PPO (its policy is a DQNPolicy): --algo ppo"),
        (PPO, "dqn", "it was not saved by DQN (its policy is a ActorCriticPolicy): --algo dqn"),
        (DQN, "qrdqn", "it was not saved by QRDQN (its policy is a DQNPolicy): --algo qrdqn"),
        (PPO, "a2c", "it was saved by PPO, not by A2C: leave out --algo a2c"),
    ],
)
def test_the_wrong_algorithm(saved_by, algo, message, tmp_path, capsys):
    make(saved_by).save(tmp_path / "model.zip")
    assert message in error_of(capsys, tmp_path / "model.zip", "--algo", algo, "--output", tmp_path)


@pytest.mark.parametrize("saved_by, algo", [(PPO, "ppo"), (CChainPPO, "ppo_cchain"), (PPO, "ppo_trac"), (A2C, "a2c")])
def test_the_right_algorithm(saved_by, algo, tmp_path, monkeypatch):
    make(saved_by).save(tmp_path / "model.zip")
    monkeypatch.setattr(sb3_cchain.zoo.inspect, "inspect_model", lambda model, *_: (_ for _ in ()).throw(Started(model)))
    with pytest.raises(Started) as started:
        command("inspect", tmp_path / "model.zip", "--algo", algo, "--env", "CartPole-v1", "--output", tmp_path)
    assert type(started.value.args[0]) is saved_by


class Started(Exception):
    """The work did, with a model."""


@pytest.mark.parametrize("name", ["args.yml", "config.yml"])
@pytest.mark.parametrize("text", ["a: [", "!!python/object/apply:os.mkdir [made]", "- a list"])
def test_broken_yaml_beside_the_model(name, text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    make().save(tmp_path / "model.zip")
    (tmp_path / "CartPole-v1").mkdir()
    (tmp_path / "CartPole-v1" / name).write_text(text)
    line = error_of(capsys, tmp_path / "model.zip", "--output", "output")
    assert "model.zip" in line and name in line and re.search("while parsing|python/object|must map", line)
    assert not (tmp_path / "made").exists()


def test_output_that_cannot_be_written_to(tmp_path, monkeypatch, capsys):
    make().save(tmp_path / "model.zip")
    (tmp_path / "file").touch()
    mend = "Give a folder that can be written to"
    for output in (tmp_path / "file", tmp_path / "file" / "below"):
        line = error_of(capsys, tmp_path / "model.zip", "--output", output)
        assert line.startswith(f"--output {output}: ") and line.endswith(mend)

    def full(*_, **__):
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("sb3_cchain.checkpoint.files.TemporaryFile", full)
    line = error_of(capsys, tmp_path / "model.zip", "--output", tmp_path / "full")
    assert line == f"--output {tmp_path / 'full'}: No space left on device. {mend}"


# A likely finding, and a possible one
SYMPTOMS = {"healthy": {}, "likely": {"weight_gain/layer": 100.0}, "possible": {"discount": 0.0}}


@pytest.mark.parametrize(
    "kind, options, code",
    [
        ("healthy", ["--fail-on", "possible"], 0),
        ("likely", [], 3),
        ("likely", ["--fail-on", "possible"], 3),
        ("likely", ["--fail-on", "never"], 0),
        ("likely", ["--ignore", "exploding_weights"], 0),
        ("likely", ["--ignore", "short_horizon"], 3),
        ("possible", [], 0),
        ("possible", ["--fail-on", "possible"], 3),
        ("possible", ["--fail-on", "possible", "--ignore", "no_exploration", "short_horizon"], 0),
    ],
)
def test_exit_codes_and_json(kind, options, code, tmp_path, monkeypatch, capsys):
    make().save(tmp_path / "model.zip")
    symptoms = SYMPTOMS[kind]

    def found(model, name, *_):
        return Inspection(name, {}, algorithm="PPO", symptoms=symptoms, findings=diagnose(symptoms, model))

    monkeypatch.setattr(sb3_cchain.zoo.inspect, "inspect_model", found)
    arguments = ["inspect", tmp_path / "model.zip", "--env", "CartPole-v1", "--output", tmp_path, "--json", *options]
    if code:
        with pytest.raises(SystemExit) as exit_info:
            command(*arguments)
        assert exit_info.value.code == code
    else:
        command(*arguments)
    output = capsys.readouterr()
    printed = json.loads(output.out)
    assert printed["version"] == 1 and printed["exit_code"] == code
    (model,) = printed["models"]
    assert set(model) == {"file", "env", *OF_A_MODEL} and model["file"] == str(tmp_path / "model.zip")
    assert model["measures"] == symptoms and "collapsed_policy" in model["not_measured"]
    if kind == "healthy" or "exploding_weights" in options or "no_exploration" in options:
        assert model["findings"] == [] and "no findings" in output.err
    else:
        (finding,) = model["findings"]
        assert set(finding) == OF_A_FINDING and finding["certainty"] == kind
        assert set(finding["remedies"][0]) == {"title", "line", "method"}
        assert finding["title"].split()[0] in output.err


OF_A_MODEL = {"name", "algorithm", "num_timesteps", "findings", "measures", "not_measured"}
OF_A_FINDING = {"name", "title", "certainty", "measure", "value", "part", "sick", "threshold", "meaning", "source", "remedies"}


def test_a_model_that_is_not_finite_is_found_and_not_refused(tmp_path, monkeypatch, capsys):
    model = make()
    with th.no_grad():
        model.policy.value_net.weight[0, 0] = th.nan
    model.save(tmp_path / "model.zip")
    monkeypatch.setattr(sb3_cchain.zoo.inspect, "inspect_model", inspect_model)
    page = tmp_path / "pages" / "page.html"
    arguments = ["--env", "CartPole-v1", "--output", tmp_path, "--html", page]
    with pytest.raises(SystemExit) as exit_info:
        command("inspect", tmp_path / "model.zip", *arguments)
    assert exit_info.value.code == 3
    assert "weight gain inf in value_net.weight" in page.read_text() and "Findings: 1 likely" in page.read_text()
    assert "The weights have grown huge" in " ".join(capsys.readouterr().out.split())


def test_statistics_of_vec_normalize(tmp_path, monkeypatch, capsys):
    model = make()
    model.save(tmp_path / "model.zip")
    normalize = VecNormalize(model.env)
    normalize.obs_rms.mean += 7
    normalize.save(tmp_path / "statistics.pkl")
    monkeypatch.setattr(sb3_cchain.zoo.inspect, "inspect_model", lambda model, *_: (_ for _ in ()).throw(Started(model)))
    arguments = ["--output", tmp_path, "--vec-normalize", tmp_path / "statistics.pkl"]
    with pytest.raises(Started) as started:
        command("inspect", tmp_path / "model.zip", "--env", "CartPole-v1", *arguments)
    assert (started.value.args[0].get_vec_normalize_env().obs_rms.mean == 7).all()
    (tmp_path / "statistics.pkl").write_text("none")
    assert "statistics.pkl cannot be read" in error_of(capsys, tmp_path / "model.zip", *arguments)
    (tmp_path / "statistics.pkl").unlink()
    assert "no such file" in error_of(capsys, tmp_path / "model.zip", *arguments)


def test_maskable_ppo_needs_masks(tmp_path, capsys):
    env = ActionMasker(gym.make("CartPole-v1"), lambda _: np.ones(2, dtype=bool))
    MaskablePPO("MlpPolicy", env, n_steps=8, batch_size=8).save(tmp_path / "model.zip")
    assert "has no method `action_masks`" in error_of(capsys, tmp_path / "model.zip", "--output", tmp_path)


def test_a_page_that_cannot_be_written(tmp_path, capsys):
    make().save(tmp_path / "model.zip")
    (tmp_path / "file").touch()
    for page, message in ((tmp_path / "file" / "page.html", "can be written to"), (tmp_path, "it is a folder")):
        assert message in error_of(capsys, tmp_path / "model.zip", "--output", tmp_path, "--html", page)


@pytest.mark.parametrize(
    "file, arguments",
    [
        ("args.yml", ["--env-kwargs", "n_tasks:2", "offsets:[[0.0]*4,[0.5]*4]", *SHORT_PPO]),
        # As from a YAML file
        ("config.yml", [*SHORT_PPO, "env_kwargs:dict(n_tasks=2, offsets=[[0.0]*4,[0.5]*4])"]),
    ],
)
def test_arguments_that_rl_zoo_saved_are_used(file, arguments, tmp_path, monkeypatch):
    """Written by RL Zoo, read by our loader."""
    options = ("--env", "Continual/CartPole-v1", "-n", "32", "-f", tmp_path, *FAST, *NO_EVALUATION)
    command("train", "--algo", "ppo", *options, *arguments)
    (folder,) = tmp_path.glob("ppo/*_1")
    saved = yaml.load((folder / "Continual-CartPole-v1" / file).read_text(), yaml.UnsafeLoader)
    assert saved["env_kwargs"]["n_tasks"] == 2
    monkeypatch.setattr(sb3_cchain.zoo.inspect, "inspect_model", lambda model, *_: (_ for _ in ()).throw(Started(model)))
    with pytest.raises(Started) as started:
        command("inspect", folder / "Continual-CartPole-v1.zip", "--env", "Continual/CartPole-v1", "--output", tmp_path)
    env = started.value.args[0].env
    assert env.get_attr("n_tasks") == [2] and json.dumps(env.get_attr("offsets")[0].tolist())[:2] == "[["
