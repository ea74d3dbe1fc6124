"""The models: trained once, and kept."""

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from benchmarks.doctor.cases import CASES, CHOSEN_ON, Case
from sb3_cchain.checkpoint.model_files import save_model, save_statistics


@dataclass(frozen=True)
class Patient:
    """
    A saved model.

    :param case_name: Key of ``CASES``
    :param steps: Environment steps after which it was saved
    :param folder: Folder of all models
    """

    case_name: str
    steps: int
    folder: Path

    @property
    def case(self) -> Case:
        """The training that it is of."""
        return CASES[self.case_name]

    @property
    def name(self) -> str:
        """Its name."""
        return f"{self.case_name}@{self.steps}"

    @property
    def is_held_out(self) -> bool:
        """Whether no threshold was chosen on it."""
        return self.case_name not in CHOSEN_ON

    @property
    def path(self) -> Path:
        """Its file."""
        return self.folder / f"{self.name}.zip"

    @property
    def statistics(self) -> Path:
        """Those of ``VecNormalize``, where there is one."""
        return self.folder / f"{self.name}.pkl"

    def make_env(self, seed: int) -> VecEnv:
        """
        :param seed: Seed
        :return: The environment of its training, with the statistics if there are
        """
        env = make_env(self.case, seed)
        return VecNormalize.load(str(self.statistics), env.venv) if isinstance(env, VecNormalize) else env


def patients(folder: Path) -> list[Patient]:
    """
    :param folder: Folder of all models
    :return: All models, whether they are there or not
    """
    return [Patient(name, steps, folder) for name, case in CASES.items() for steps in case.ages]


def make_env(case: Case, seed: int) -> VecEnv:
    """
    :param case: A training
    :param seed: Seed
    :return: Its environment
    """
    env = make_vec_env(case.env, case.n_envs, seed=seed, wrapper_class=case.wrap)
    return VecNormalize(env, gamma=case.settings.get("gamma", 0.99)) if case.normalize else env


class SaveAtAges(BaseCallback):
    """
    Saves the model, and the statistics of its ``VecNormalize``, when a rollout begins at or after each age.

    :param patients: The models to save
    """

    def __init__(self, patients: list[Patient]):
        super().__init__()
        self.waiting = sorted(patients, key=lambda patient: patient.steps)

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        while self.waiting and self.num_timesteps >= self.waiting[0].steps:
            self._save(self.waiting.pop(0))

    def _on_training_end(self) -> None:
        for patient in self.waiting:
            self._save(patient)

    def _save(self, patient: Patient) -> None:
        save_statistics(self.model, patient.statistics)
        save_model(self.model, patient.path)


def train_missing(wanted: list[Patient]) -> None:
    """
    Train the models that are not there.

    :param wanted: Models
    """
    for name in dict.fromkeys(patient.case_name for patient in wanted if not patient.path.exists()):
        case = CASES[name]
        model = make_model(case)
        model.learn(max(case.ages), callback=SaveAtAges([patient for patient in wanted if patient.case_name == name]))
        assert model.env is not None
        model.env.close()


def make_model(case: Case) -> BaseAlgorithm:
    """
    :param case: A training
    :return: Its model, untrained
    """
    settings = deepcopy(dict(case.settings))  # algorithms may write into `policy_kwargs`
    np.random.seed(case.seed)
    model = case.algorithm(case.policy, make_env(case, case.seed), seed=case.seed, device="cpu", **settings)
    if case.prepare is not None:
        case.prepare(model)
    return model
