"""Laws of what strangers hand to the verbs: one line, soon, in little memory; nothing written."""

import re

import pytest
from reports.hostile import CASES as FILES
from reports.measure import table_of
from reports.strangers import CASES, REQUESTS, Case, Outcome, Request

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def outcomes() -> dict[str, Outcome]:
    """All of them in one process of its own: its memory is measured."""
    return table_of("strangers.py", Outcome, timeout=400)


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_what_a_verb_cannot_use_is_refused_in_one_line(outcomes, case: Case):
    outcome = outcomes[case.name]
    assert outcome.status == 2 and len(outcome.lines) == 1, outcome
    line = outcome.lines[0]
    assert line.startswith("flx: ") and ";" in line and re.search(case.match, line), line
    assert len(line) < 400 and not outcome.written, outcome
    assert outcome.seconds < 10 and outcome.megabytes < 2000, outcome


@pytest.mark.parametrize("asked", REQUESTS, ids=lambda request: request.name)
def test_what_a_page_may_not_send_is_answered_in_one_line(outcomes, asked: Request):
    outcome = outcomes[asked.name]
    assert outcome.status in (400, 403, 404, 411, 413) and len(outcome.lines) == 1, outcome
    assert re.search(asked.match, outcome.lines[0]) and len(outcome.lines[0]) < 300
    assert not outcome.written and outcome.seconds < 5, outcome


def test_there_are_as_many_as_are_promised():
    names = [case.name for case in (*FILES, *CASES, *REQUESTS)]
    assert len(names) == len(set(names)) >= 300
