"""Laws of bad input: refused in one line with status 2, soon, in little memory; nothing written or called."""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from reports.hostile import CASES, GOOD, HEAVY, Case, Outcome
from reports.measure import table_of


@pytest.fixture(scope="module")
def outcomes() -> dict[str, Outcome]:
    """What `flx doctor` did with every case, in one process of its own: its memory is measured."""
    return table_of("hostile.py", Outcome, timeout=300)


@pytest.mark.slow
@pytest.mark.parametrize("name", GOOD)
def test_a_file_is_accepted_before_it_is_spoilt(outcomes, name):
    assert outcomes[name].status == 0 and not outcomes[name].lines and "vertices" in outcomes[name].said
    assert not outcomes[name].opened  # the watcher is not blind: see the next test but one


@pytest.mark.slow
@pytest.mark.parametrize("name", HEAVY)
def test_a_file_that_multiplies_work_is_read_soon_and_in_little_memory(outcomes, name):
    outcome = outcomes[name]
    assert outcome.status == 0 and not outcome.lines and "vertices" in outcome.said, outcome
    # Work that multiplies takes minutes; reading all of the largest file takes up to 5 s on slow machines.
    assert outcome.seconds < 15 and outcome.megabytes < 1000, outcome


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_hostile_file_is_refused_in_one_line(outcomes, case: Case):
    outcome = outcomes[case.name]
    assert outcome.status == 2 and len(outcome.lines) == 1, outcome
    line = outcome.lines[0]
    assert line.startswith("flx: ") and ";" in line and re.search(case.match, line), line
    assert not outcome.said and len(line) < 300
    assert not outcome.written and not outcome.opened
    assert outcome.seconds < 5 and outcome.megabytes < 1000, outcome


def test_the_watcher_sees_what_is_opened_and_written(tmp_path):
    script = (
        "import hostile, sys; sys.addaudithook(hostile._watch); open('/etc/hosts'); print(hostile._watched)"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=Path(__file__).parent, capture_output=True, text=True
    )
    assert "/etc/hosts" in done.stdout
