"""Networks of toy demonstrations: trained ones, and unfinished ones where only the form counts."""

import pytest
import torch

from services.evaluation.policies.cloning_training import CloningSettings, train_cloned_policy
from services.evaluation.success_classifier_training import (
    ClassifierSettings,
    train_success_classifier,
)
from tests.unit.evaluation import toy
from tests.unit.evaluation.shown_endings import ending_episode


@pytest.fixture(scope="session", autouse=True)
def _one_thread():
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def demonstrations():
    return toy.demonstrations(range(45), noise_m=0.03)


@pytest.fixture(scope="session")
def trained_policies(demonstrations):
    settings = CloningSettings(num_training_steps=250, batch_size=32, learning_rate=3e-3)
    episodes = [toy.cloning_episode(item) for item in demonstrations]
    return train_cloned_policy(episodes, settings, command="a test", early_at=0.02)


@pytest.fixture(scope="session")
def policy_checkpoint(demonstrations):
    settings = CloningSettings(num_training_steps=3, batch_size=32)
    episodes = [toy.cloning_episode(item) for item in demonstrations]
    return train_cloned_policy(episodes, settings, command="a test", early_at=0.5)[0]


def _probe(demonstrations, num_steps):
    settings = ClassifierSettings(num_training_steps=num_steps, batch_size=32, learning_rate=3e-3)
    return train_success_classifier(
        [ending_episode(d) for d in demonstrations], settings, command="a test"
    )


@pytest.fixture(scope="session")
def trained_probe(demonstrations):
    return _probe(demonstrations, 350)


@pytest.fixture(scope="session")
def probe_checkpoint(demonstrations):
    return _probe(demonstrations, 3)
