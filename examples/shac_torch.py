"""Train an ant in PyTorch with the gradient of the simulation, in short windows.

    python examples/shac_torch.py

The short-horizon actor-critic (Xu et al. 2022): the actor follows the gradient of the
rewards of 8 steps, plus the value that a critic gives to the state after them. An
episode that ends earns no more in its window, and begins again. Needs ``torch``.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

import newton_qd
from newton_qd.adapters.torch import detached, make_torch_step

DISCOUNT = 0.97


def network(inputs: int, outputs: int, *last: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 64), nn.ELU(), nn.Linear(64, outputs), *last)


def limited(slope: torch.Tensor | None) -> torch.Tensor | None:
    """Clips the gradient of each world's state: contact makes some very large."""
    if slope is None:
        return None
    return slope * (100 / (slope.norm(dim=-1, keepdim=True) + 1e-9)).clamp(max=1)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=16)
    parser.add_argument("--window", type=int, default=8, help="steps of 0.05 s")
    parser.add_argument("--iterations", type=int, default=500)
    arguments = parser.parse_args(argv)

    env = newton_qd.create("ant", 250, batch_size=arguments.worlds)
    reset, step = make_torch_step(env)
    torch.manual_seed(0)
    actor = network(env.observation_size, env.action_size, nn.Tanh())
    critic = network(env.observation_size, 1)
    actor_steps = torch.optim.Adam(actor.parameters(), 5e-3)
    critic_steps, state = torch.optim.Adam(critic.parameters(), 2e-3), reset(0)
    for iteration in range(arguments.iterations + 1):
        state, seen, past = detached(state), [], []
        gain, weight = torch.zeros(()), torch.ones(arguments.worlds)
        for _ in range(arguments.window):
            seen.append(state.obs.clamp(-5, 5))
            action = actor(seen[-1])
            state = step(state, action + 0.1 * torch.randn_like(action))
            for part in (state.pipeline_state.q, state.pipeline_state.v):
                part.register_hook(limited)
            gain = gain + (weight * state.reward).sum()
            past.append((state.reward.detach(), state.done.detach()))
            weight = weight * DISCOUNT * (1 - past[-1][1])
        last = critic(state.obs.clamp(-5, 5)).squeeze(-1)
        actor_steps.zero_grad()
        (-gain - (weight * last).sum()).backward()
        actor_steps.step()
        wanted = [last.detach()]
        for reward, done in reversed(past):
            wanted.append(reward + DISCOUNT * wanted[-1] * (1 - done))
        values, before = torch.stack(wanted[:0:-1]), torch.stack(seen).detach()
        for _ in range(8):
            critic_steps.zero_grad()
            nn.functional.mse_loss(critic(before).squeeze(-1), values).backward()
            critic_steps.step()
        if iteration % max(arguments.iterations // 10, 1) == 0:
            mean = torch.stack([reward for reward, _ in past]).mean()
            print(f"iteration {iteration:3d}: mean reward of a step {mean:.3f}")


if __name__ == "__main__":
    main()
