"""
7. Guard your figures in CI
===========================

``elastic bench`` plays short rollouts. It ends with exit code 1 where a figure got worse than the
file accepts.
"""

import re
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
cases = folder / "my_bench.yaml"
cases.write_text("""
cases:
- {env: testbed, policy: input, reference: {kind: sine, duration_s: 4.0}, figures: {link_error_rms_rad: 0.1}}
- {env: testbed, policy: dynamic, reference: {kind: sine, duration_s: 4.0}, figures: {link_error_rms_rad: 0.1}}
""")  # noqa: E501

# %%
# Accept the figures of today. This writes them into the file.

assert elastic("bench", str(cases), "--update", "--output", str(folder / "accepted")) == 0
print(cases.read_text())

# %%
# From now on the same command guards them.

assert elastic("bench", str(cases), "--output", str(folder / "guarded")) == 0

# %%
# A policy that got worse fails. We pretend that by accepting half of its error.

text = cases.read_text()
figure = re.findall(r"link_error_rms_rad: ([\d.e-]+)", text)[0]
cases.write_text(text.replace(figure, f"{float(figure) / 2:.4g}", 1))
print("exit code", elastic("bench", str(cases), "--output", str(folder / "worse")))

# %%
# The page on commands has a workflow for GitHub that runs it.
