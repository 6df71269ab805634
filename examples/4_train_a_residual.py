"""
4. Train a residual, and read the report
========================================

A residual adds a learned correction to a compensator. A minute of training shows the way. It does
not show what learning is worth. That takes five training seeds and more decisions, see
``configs/train_testbed.yaml``.
"""

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
(folder / "train.yaml").write_text("""
name: small
env: testbed
reference: multisine
scenarios: [nominal]
env_options: {timestep_s: 0.001}
base: input
settings: {acts_on: {command: 0.04}, decision_period: 2, cutoff_hz: 20, history: 4}
worlds: 64
decisions: 60000
evaluate_every: 60000
evaluation_episodes: 2
checkpoint_every: 60000
seeds: [0]
""")
assert elastic("train", str(folder / "train.yaml"), "--output", str(folder / "run")) == 0

# %%
# The comparison plays the residual and its base on the same episodes, with seeds that training
# never used.

(folder / "compare.yaml").write_text(f"""
name: small
references: [multisine]
scenarios: [nominal, soft]
policies: [input, {{name: "residual:{folder}/run/seed_*/last", label: residual}}]
episodes: 2
""")
assert elastic("compare", str(folder / "compare.yaml"), "--output", str(folder / "comparison")) == 0

# %%
# ``report.html`` opens without a network. ``summary.md`` has the same sentences. With one training
# seed they say that
# nothing is judged.

assert (folder / "comparison" / "report.html").is_file()
print((folder / "comparison" / "summary.md").read_text()[:3000])
