"""Train an ant in PyTorch with the gradient of the simulation, in short windows.

    python examples/shac_torch.py

The short-horizon actor-critic (Xu et al. 2022): the actor follows the gradient of the
rewards of 16 steps, plus the value that a critic gives to the state after them. An
episode that ends earns no more in its window, and begins again. Then the graph is cut,
and the next window goes on from there. Needs the extra ``torch``.
"""

from __future__ import annotations

import argparse
import copy
from collections.abc import Sequence

import torch  # pyright: ignore[reportMissingImports]
from torch import nn  # pyright: ignore[reportMissingImports]

import newton_qd
from newton_qd.adapters.torch import detached, make_torch_step


def network(inputs: int, outputs: int, *last: nn.Module) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, 64), nn.ELU(), nn.Linear(64, outputs), *last)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--worlds", type=int, default=64)
    parser.add_argument("--window", type=int, default=16, help="steps of 0.05 s")
    parser.add_argument("--iterations", type=int, default=200)
    arguments = parser.parse_args(argv)

    options = {"batch_size": arguments.worlds, "use_contact_forces": False}
    env = newton_qd.create("ant", 250, **options)
    reset, step = make_torch_step(env)
    torch.manual_seed(0)
    actor = network(env.observation_size, env.action_size, nn.Tanh())
    actor[2].weight.data *= 0.1  # a policy that reacts little has a useful gradient
    critic = network(env.observation_size, 1)
    target, discount = copy.deepcopy(critic), 0.99
    actor_steps = torch.optim.Adam(actor.parameters(), 3e-3, betas=(0.7, 0.95))
    critic_steps = torch.optim.Adam(critic.parameters(), 1e-3)
    state = reset(0)
    for iteration in range(arguments.iterations + 1):
        state, seen, rewards, ends = detached(state), [], [], []
        gain, weight = torch.zeros(()), torch.ones(arguments.worlds)
        for _ in range(arguments.window):
            seen.append(state.obs.clamp(-5, 5))
            state = step(state, actor(seen[-1]))
            gain = gain + (weight * state.reward).sum()
            rewards.append(state.reward.detach())
            ends.append(state.done.detach())
            weight = weight * discount * (1 - ends[-1])
        last = target(state.obs.clamp(-5, 5)).squeeze(-1)
        loss = -(gain + (weight * last).sum()) / arguments.worlds / arguments.window
        actor_steps.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(actor.parameters(), 1.0)
        actor_steps.step()
        wanted = [last.detach()]
        for reward, done in zip(reversed(rewards), reversed(ends), strict=True):
            wanted.append(reward + discount * wanted[-1] * (1 - done))
        values, before = torch.stack(wanted[:0:-1]), torch.stack(seen).detach()
        for _ in range(8):
            critic_steps.zero_grad()
            nn.functional.mse_loss(critic(before).squeeze(-1), values).backward()
            critic_steps.step()
        with torch.no_grad():
            for kept, new in zip(target.parameters(), critic.parameters(), strict=True):
                kept.lerp_(new, 0.2)
        if iteration % max(arguments.iterations // 10, 1) == 0:
            mean = torch.stack(rewards).mean()
            print(f"iteration {iteration:3d}: mean reward of a step {mean:.3f}")


if __name__ == "__main__":
    main()
