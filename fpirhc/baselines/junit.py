"""A check as JUnit XML: a suite per problem, a case per controller."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree as Xml

from fpirhc.baselines.judging import Judgement, Row
from fpirhc.baselines.words import clean, headline, remarks, rows_of, told

MARK = '<testsuites name="fpirhc check"'


def to_junit(judgements: Sequence[Judgement]) -> str:
    """Return the XML; names are escaped and characters that XML cannot hold are replaced."""
    root = Xml.Element("testsuites", name="fpirhc check")
    for judgement in judgements:
        _suite(root, judgement)
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode", xml_declaration=False) + "\n"


def _suite(root: Xml.Element, judgement: Judgement) -> None:
    by_controller = rows_of(judgement)
    unclear = bool(judgement.broken or judgement.unusable or not by_controller)
    failing = sum(any(not row.holds for row in rows) for rows in by_controller.values())
    counts = {"tests": len(by_controller) + unclear, "failures": failing, "errors": int(unclear)}
    name = clean(judgement.problem)
    suite = Xml.SubElement(root, "testsuite", {"name": name, **{k: str(v) for k, v in counts.items()}})
    if unclear:
        case = Xml.SubElement(suite, "testcase", classname=name, name="baseline")
        Xml.SubElement(case, "error", message=headline(judgement)).text = "\n".join(remarks(judgement))
    for controller, rows in by_controller.items():
        _case(suite, name, controller, rows)


def _case(suite: Xml.Element, problem: str, controller: str, rows: Sequence[Row]) -> None:
    case = Xml.SubElement(suite, "testcase", classname=problem, name=clean(controller))
    changed = [row for row in rows if not row.holds]
    if changed:
        message = f"{len(changed)} of {len(rows)} metrics changed"
        Xml.SubElement(case, "failure", message=message).text = told(changed)
