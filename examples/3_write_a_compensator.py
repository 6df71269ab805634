"""
3. Write a compensator, and put it on the leaderboard
=====================================================

A policy is an object with ``predict``. This one commands a share of what ``input_output`` commands.
Observations are ``(num_worlds, m)``: take columns as ``observation[..., k]``.
"""

# %%
# The function ``make`` gets the environment, and returns the policy. Its keyword arguments are
# options.

import subprocess
import sys
import tempfile
from pathlib import Path


def elastic(*words: str) -> int:
    """Run `elastic WORDS` as in a terminal, and show what it prints; its exit code."""
    done = subprocess.run(
        [sys.executable, "-m", "train.commands.entry", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    print(done.stdout)
    return done.returncode


folder = Path(tempfile.mkdtemp())
(folder / "mine.py").write_text('''
import numpy as np

import baselines


class Share:
    """A share of the offsets that another policy commands."""

    def __init__(self, whole, share):
        self.whole, self.share = whole, share

    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        action, state = self.whole.predict(observation, state, episode_start, deterministic)
        return np.float32(self.share) * action, state


def make(env, share=0.8):
    return Share(baselines.make("input_output", env), share)
''')

# %%
# Play it alone first.

own = ["--policy", f"{folder}/mine.py:make", "--output", str(folder / "alone")]
assert elastic("evaluate", "--env", "walker", *own, "--reference", "3", "--scenario", "soft") == 0

# %%
# The leaderboard is a comparison. This copy of ``configs/leaderboard.yaml`` is small: two
# scenarios, one episode each.

(folder / "leaderboard.yaml").write_text(f"""
name: small_leaderboard
env: walker
references: [{{step_period: 3, num_steps: 2}}]
scenarios: [nominal, soft]
groups: {{mixture: [nominal, soft]}}
leaderboard: true
policies:
  - input_output
  - {{name: "{folder}/mine.py:make", label: mine, options: {{share: 0.9}}}}
""")
assert elastic("compare", str(folder / "leaderboard.yaml"), "--output", str(folder / "board")) == 0
print((folder / "board" / "leaderboard.md").read_text())

# %%
# Less than the whole offset is worse in ``nominal`` and in ``soft``. Is a share above one better in
# ``soft``? Try it.
#
# To compensate more or less of the deflection alone, assume another stiffness:
# ``baselines.make("input_output", env, stiffness_scale=0.8)``. The page on commands has a policy
# with memory, and the
# paper's compensator around a policy of your own. The page on the leaderboard says how to submit a
# policy.
