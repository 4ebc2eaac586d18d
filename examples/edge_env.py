# SPDX-License-Identifier: Apache-2.0

"""Trains a finger to centre itself over an edge, then lets it do that on the whole simulated chain.

    .venv/bin/python examples/edge_env.py   # pip install torch gymnasium array-api-compat

A finger with a skin of 4 × 4 taxels presses on a slab with a force that nobody tells, somewhere
over its edge, which runs across it at any angle up to TURN_RAD. It feels the taxels, and moves to
and fro until the edge is under its middle. EdgeEnv is a Gymnasium VectorEnv of many such fingers;
each has a skin of its own: mismatched, noisy, late, with hysteresis, some with a dead node. PPO in
torch trains on it. Then the network, as it is, moves a finger whose skin goes through the simulated
nodes, line, digitizer and decoder. The last line compares both, and a finger that does not move.
"""

import argparse
import time
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from tactile_cdma import Skin
from tactile_cdma.sim import BatchCover, Box, Foundation, SkinBatch, at_force

Floats: TypeAlias = NDArray[np.float32]
TAXELS, FRAME_S, STEPS = 16, 12.8e-3, 60
PORT = "sim://?scene=external&speed=0&sensor=paper&sensor_noise=0.004&mismatch=0.05"
SLAB = Box(size_m=(0.06, 0.1, 0.02), position_m=(0, 0, 0))
FASTEST_M = 0.5e-3
"""Longest way in a frame, m: 39 mm/s."""
START_M, TURN_RAD, FORCES_N = 8e-3, 0.3, (0.5, 4.0)
SCALE_PA = 2e4
SKINS = 64
"""Different skins; environments share them."""


def skin_urls(envs: int, seed: int) -> list[str]:
    """Draw what the environments' sensors and nodes are like."""
    rng, urls = np.random.default_rng(seed), []
    for number in range(SKINS):
        dead = f"&dead={rng.integers(1, TAXELS + 1)}" if number % 4 == 0 else ""
        hysteresis, threshold = rng.uniform(0, 2), rng.integers(0, 3)
        urls.append(
            f"{PORT}&seed={seed + number}&hysteresis={hysteresis:.2f}&threshold={threshold}{dead}"
        )
    return [urls[env % SKINS] for env in range(envs)]


class Places:
    """Where the slabs are that the fingers press on: (e,) offset of the edge, m, turn, force, N."""

    def __init__(self, rng: np.random.Generator, envs: int) -> None:
        self.offset_m = rng.uniform(-START_M, START_M, envs).astype(np.float32)
        self.turn_rad = rng.uniform(-TURN_RAD, TURN_RAD, envs).astype(np.float32)
        self.force_n = rng.uniform(*FORCES_N, envs).astype(np.float32)

    def exchange(self, done: NDArray[np.bool_], rng: np.random.Generator) -> None:
        """Draw those anew that are done."""
        fresh = vars(Places(rng, len(done)))
        for name, old in vars(self).items():
            setattr(self, name, np.where(done, fresh[name], old))

    def poses(self) -> tuple[Floats, Floats]:
        """Return positions, (e, 3), m, and quaternions, (e, 4), of the slabs: its edge is x = 0."""
        half_m, turn = SLAB.size_m[0] / 2, self.turn_rad
        x_m, y_m = self.offset_m + half_m * np.cos(turn), half_m * np.sin(turn)
        nothing = np.zeros_like(turn)
        turned = np.stack([nothing, nothing, np.sin(turn / 2), np.cos(turn / 2)], axis=1)
        place_m = np.stack([x_m, y_m, nothing + np.float32(SLAB.size_m[2] / 2)], axis=1)
        return place_m.astype(np.float32), turned.astype(np.float32)


def seen(pressure_pa: Any, moved: Any) -> Floats:
    """Turn pressures, (e, t), and the last moves, (e,), into observations; unread taxels are 0."""
    felt = np.nan_to_num(pressure_pa) / SCALE_PA
    return np.concatenate([np.clip(felt, 0, 3), moved[:, None]], axis=1).astype(np.float32)


class EdgeEnv(VectorEnv):  # type: ignore[type-arg]
    """Fingers over edges. Actions: (e, 1), −1 to 1, the way in a frame, in FASTEST_M.

    Observations: (e, 17), taxels in SCALE_PA and the last action. The reward is minus the edge's
    distance from the middle, in 10 mm. An episode has STEPS frames.
    """

    metadata = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, num_envs: int = 256, seed: int = 0) -> None:
        skin = Skin(PORT, nodes=TAXELS)
        self.num_envs, self._cover = num_envs, BatchCover(skin.layout)
        self._batch = SkinBatch(skin.config, num_envs, skin_urls(num_envs, seed), tared=True)
        self.single_observation_space = gymnasium.spaces.Box(-1, 3, (TAXELS + 1,))
        self.single_action_space = gymnasium.spaces.Box(-1, 1, (1,))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._rng = np.random.default_rng(seed)
        self._fresh = self._batch.begin(np.zeros((), np.float32))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin all episodes."""
        if seed is not None:
            self._rng = np.random.default_rng(seed)
        self._places, self._state = Places(self._rng, self.num_envs), self._fresh
        self._moved = np.zeros(self.num_envs, np.float32)
        # Episodes end at different times, so that steps of all ages are in each of them.
        self._age = self._rng.integers(STEPS, size=self.num_envs)
        return self._feel(), {}

    def step(self, actions: Any) -> tuple[Floats, Any, Any, Any, dict[str, Any]]:
        """Move the fingers, and begin those episodes anew that end."""
        self._moved = np.clip(np.asarray(actions, np.float32)[:, 0], -1, 1)
        self._places.offset_m -= FASTEST_M * self._moved
        reward = -np.abs(self._places.offset_m) / np.float32(0.01)
        observation, info = self._feel(), {"offset_m": self._places.offset_m.copy()}
        self._age += 1
        ended = self._age >= STEPS
        if ended.any():
            info["final_obs"] = observation
            self._places.exchange(ended, self._rng)
            self._state = self._batch.reset(self._state, self._fresh, ended)
            self._age[ended], self._moved = 0, np.where(ended, 0, self._moved)
            observation = np.where(ended[:, None], np.float32(0), observation)
        return observation, reward, np.zeros_like(ended), ended, info

    def _feel(self) -> Floats:
        place_m, turned = self._places.poses()
        pressure_pa = self._cover.pressure_pa(SLAB, place_m, turned, self._places.force_n)
        noise = self._rng.standard_normal(pressure_pa.shape, np.float32)
        self._state, frame = self._batch.step(self._state, pressure_pa, noise)
        return seen(frame.pressure_pa, self._moved)


class Policy(torch.nn.Module):
    """Two small networks: how to move, with a spread that is learnt, and what that is worth."""

    def __init__(self) -> None:
        super().__init__()
        self.mean, self.value = (
            torch.nn.Sequential(
                torch.nn.Linear(TAXELS + 1, 64), torch.nn.Tanh(),
                torch.nn.Linear(64, 64), torch.nn.Tanh(), torch.nn.Linear(64, 1),
            )
            for _ in range(2)
        )  # fmt: skip
        self.spread = torch.nn.Parameter(torch.full((1,), -0.5))

    def moves(self, observation: torch.Tensor) -> torch.distributions.Normal:
        return torch.distributions.Normal(self.mean(observation), self.spread.exp())


def trained(env: EdgeEnv, rounds: int, seed: int = 0) -> Policy:
    """Train by PPO; each round is half an episode of all environments."""
    torch.manual_seed(seed)
    policy = Policy()
    optimizer = torch.optim.Adam(policy.parameters(), 1e-3)
    observation, _ = env.reset(seed=seed)
    for number in range(rounds):
        rows: list[tuple[torch.Tensor, ...]] = []
        for _ in range(STEPS // 2):
            now = torch.from_numpy(observation)
            with torch.no_grad():
                moves = policy.moves(now)
                action, worth = moves.sample(), policy.value(now)[:, 0]
            observation, reward, _, ended, info = env.step(action.numpy())
            likely = moves.log_prob(action)[:, 0]
            given = (torch.from_numpy(each.astype(np.float32)) for each in (reward, ended))
            rows.append((now, action, likely, worth, *given))
        with torch.no_grad():
            after = policy.value(torch.from_numpy(observation))[:, 0]
        update(
            policy, optimizer, [torch.stack(column) for column in zip(*rows, strict=True)], after
        )
        if number % 10 == 9:
            off_mm = 1e3 * np.abs(info["offset_m"]).mean()
            print(f"round {number + 1}: {off_mm:.2f} mm off, all ages", flush=True)
    return policy


def update(
    policy: Policy, optimizer: torch.optim.Optimizer, rows: list[torch.Tensor], after: torch.Tensor
) -> None:
    """One round of PPO: advantages by GAE, and four passes over the rows."""
    seen_then, action, likely, worth, reward, ended = rows
    gain, advantage = torch.zeros_like(after), torch.zeros_like(worth)
    for step in reversed(range(len(worth))):
        # An episode's end is one of time: what would come is worth what it was before.
        follows = torch.where(ended[step] > 0, worth[step], after)
        gain = reward[step] + 0.95 * follows - worth[step] + 0.9 * (1 - ended[step]) * gain
        advantage[step], after = gain, worth[step]
    wanted = (advantage + worth).ravel()
    flat = [each.reshape(-1, *each.shape[2:]) for each in (seen_then, action, likely, advantage)]
    for _ in range(4):
        for part in torch.randperm(len(wanted)).split(2048):
            observation, action, likely, advantage = (each[part] for each in flat)
            moves = policy.moves(observation)
            ratio = (moves.log_prob(action)[:, 0] - likely).exp()
            better = (advantage - advantage.mean()) / (advantage.std() + 1e-6)
            cut = torch.minimum(ratio * better, ratio.clamp(0.8, 1.2) * better)
            error = (policy.value(observation)[:, 0] - wanted[part]).square()
            loss = error.mean() - cut.mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()


def acted(policy: Policy, observation: Floats) -> Floats:
    """Let the policy move without its spread."""
    with torch.no_grad():
        moves = policy.mean(torch.from_numpy(observation)).clamp(-1, 1)
    return np.asarray(moves.numpy())


def off_in_batch(policy: Policy, envs: int, seed: int) -> Floats:
    """Return how far edges are from the middle at the end of an episode, (e,), m."""
    env = EdgeEnv(envs, seed)
    observation, _ = env.reset(seed=seed)
    env._age[:] = 0
    for _ in range(STEPS):
        observation, _, _, _, info = env.step(acted(policy, observation))
    return np.asarray(np.abs(info["offset_m"]))


def off_in_chain(policy: Policy | None, episodes: int, seed: int) -> Floats:
    """Return the same of fingers with nodes, line, digitizer and driver, (episodes,), m."""
    rng = np.random.default_rng(seed)
    return np.array([one_in_chain(policy, rng, url) for url in skin_urls(episodes, seed)])


def one_in_chain(policy: Policy | None, rng: np.random.Generator, url: str) -> float:
    places, moved = Places(rng, 1), np.zeros(1, np.float32)
    with Skin(url, nodes=TAXELS) as skin:
        layout = skin.layout
        cover = Foundation(layout.positions_m, layout.normals, layout.areas_m2, layout.aspect)
        for _ in range(TAXELS * 6):  # until every node has spoken
            frame = skin.step()
        rest_pa = np.nan_to_num(frame.pressure_pa)
        for _ in range(STEPS if policy else 0):
            # Of the frame before, as one is late.
            observation = seen((frame.pressure_pa - rest_pa)[None], moved)
            moved = acted(policy, observation)[:, 0] if policy else moved
            places.offset_m -= FASTEST_M * moved
            place_m, turned = places.poses()
            slab = Box(
                size_m=SLAB.size_m,
                position_m=place_m[0].tolist(),
                orientation_xyzw=turned[0].tolist(),
            )
            frame = skin.step(at_force(cover, slab, float(places.force_n[0])))
    return abs(float(places.offset_m[0]))


def results(rounds: int, envs: int, episodes: int) -> dict[str, float]:
    """Train, and try the policy in the batch and in the chain; medians in mm."""
    begun_s = time.monotonic()
    policy = trained(EdgeEnv(envs), rounds)
    took_s = time.monotonic() - begun_s
    start, chain = (off_in_chain(each, episodes, 900) for each in (None, policy))
    return {
        "frames": rounds * envs * STEPS // 2,
        "trained_s": round(took_s),
        "start_mm": round(1e3 * float(np.median(start)), 2),
        "batch_mm": round(1e3 * float(np.median(off_in_batch(policy, 256, 900))), 2),
        "chain_mm": round(1e3 * float(np.median(chain)), 2),
        "chain_within_1mm_percent": round(100 * float(np.mean(chain < 1e-3))),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="Trains a finger to centre itself over an edge.")
    parser.add_argument("--rounds", type=int, default=60)
    parser.add_argument("--envs", type=int, default=256)
    parser.add_argument("--episodes", type=int, default=64, help="in the whole simulated chain")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    found = results(arguments.rounds, arguments.envs, arguments.episodes)
    print(*(f"{name}={value}" for name, value in found.items()))


if __name__ == "__main__":
    main()
