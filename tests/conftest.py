"""What all tests share: fixed examples, so that a run says the same thing twice."""

from __future__ import annotations

from hypothesis import settings

settings.register_profile("fixed", deadline=None, derandomize=True, max_examples=60)
settings.load_profile("fixed")

pytest_plugins = ["estimation.synthetic.plugin"]  # by name, so that a checkout that is not installed has it too
