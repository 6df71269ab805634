"""Settings of the whole suite: hypothesis repeats itself exactly and leaves no files behind."""

from hypothesis import settings

settings.register_profile("repeatable", derandomize=True, database=None, deadline=None, max_examples=60)
settings.load_profile("repeatable")
