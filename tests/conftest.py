"""Settings of the whole suite: pictures without a display, nothing kept from another run;
hypothesis repeats itself and leaves no files behind."""

import os
import signal
import tempfile

from hypothesis import settings

from elastic_env.core.disk_cache import VARIABLE
from elastic_env.rendering.headless import prefer_egl

prefer_egl()
# the processes of a run share where robots rest, which is the same to the last bit
if "PYTEST_XDIST_WORKER" not in os.environ:
    _OF_THIS_RUN = tempfile.TemporaryDirectory(
        prefix="elastic_env_tests_", ignore_cleanup_errors=True
    )
    os.environ[VARIABLE] = _OF_THIS_RUN.name
# a shell's background jobs ignore Ctrl-C, and so would the programs that tests start and interrupt
signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile(
    "repeatable", derandomize=True, database=None, deadline=None, max_examples=60
)
settings.load_profile("repeatable")
