"""Settings of the whole suite: pictures without a display; hypothesis repeats itself and leaves no files behind."""

from hypothesis import settings

from elastic_env.headless import prefer_egl

prefer_egl()

settings.register_profile("repeatable", derandomize=True, database=None, deadline=None, max_examples=60)
settings.load_profile("repeatable")
