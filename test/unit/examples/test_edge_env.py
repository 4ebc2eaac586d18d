# SPDX-License-Identifier: Apache-2.0

"""The Gymnasium environment of fingers over edges keeps to the interface, and can be solved."""

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium", reason="gymnasium is not installed")
pytest.importorskip("torch", reason="torch is not installed")

from test.support.scripts import loaded

edge_env = loaded(Path(__file__).resolve().parents[3] / "examples" / "edge_env.py")


def test_fingers_that_know_where_the_edge_is_centre_it_and_begin_anew() -> None:
    envs = [edge_env.EdgeEnv(8, seed) for seed in (3, 3, 4)]
    firsts = [env.reset(seed=seed)[0] for env, seed in zip(envs, (3, 3, 4), strict=True)]
    places = [env._places.offset_m for env in envs]
    assert np.array_equal(places[0], places[1]) and not np.array_equal(places[0], places[2])
    env, ends = envs[0], np.zeros(8, int)
    env._age[:4] = 0
    assert firsts[0].shape == env.observation_space.shape
    last_m = np.full(8, np.inf)
    for _ in range(edge_env.STEPS):
        offset_m = env._places.offset_m
        observation, reward, died, ended, info = env.step(offset_m[:, None] / edge_env.FASTEST_M)
        last_m = np.where(ended, np.abs(info["offset_m"]), last_m)
        ends += ended
        assert env.observation_space.contains(observation) and not died.any()
        assert np.allclose(reward, -np.abs(info["offset_m"]) / 0.01)
    assert (ends == 1).all(), "every episode ends once in so many frames"
    assert (last_m[:4] < 1e-6).all(), "the whole episode was there for these"
