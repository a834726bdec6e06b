"""Laws of the API's door: a wrong argument is a ValueError in the caller's words; nothing is written."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest
from reports.door import CALLS, GOOD, Answer, Call


@pytest.fixture(scope="module")
def answers() -> dict[str, Answer]:
    script = Path(__file__).parent / "door.py"
    done = subprocess.run([sys.executable, script, "--json"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return {name: Answer(*row) for name, row in json.loads(done.stdout).items()}


@pytest.mark.parametrize("name", GOOD)
def test_what_can_be_used_is_taken(answers, name):
    assert not answers[name].kind, answers[name]


@pytest.mark.parametrize("call", CALLS, ids=lambda call: call.name)
def test_a_wrong_argument_is_a_value_error_in_the_callers_words(answers, call: Call):
    answer = answers[call.name]
    assert answer.kind == "ValueError" and re.search(call.match, answer.said), answer
    assert "\n" not in answer.said and len(answer.said) < 400 and not answer.warned, answer


def test_nothing_is_written(answers):
    assert answers["left in the folder"].said == "a.ply, f.ply"
