"""A generator that the tests of this folder share."""

import pytest
from helpers.generators import ball_generator

from flx.pipeline.generator import Generator


@pytest.fixture(scope="session")
def generator(tmp_path_factory) -> Generator:
    return ball_generator(tmp_path_factory.mktemp("asset"))
