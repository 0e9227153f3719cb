"""The output of a check as JUnit XML: a suite per problem, a case per controller."""

from __future__ import annotations

from xml.etree import ElementTree as Xml

from fpirhc.baselines.outline import Case, Outline, Section

MARK = '<testsuites name="fpirhc check"'


def to_junit(outline: Outline) -> str:
    """Return the XML; names are escaped."""
    root = Xml.Element("testsuites", name="fpirhc check")
    for section in outline.sections:
        _suite(root, section)
    Xml.indent(root)
    return Xml.tostring(root, encoding="unicode", xml_declaration=False) + "\n"


def _suite(root: Xml.Element, section: Section) -> None:
    failing = sum(bool(case.changed) for case in section.cases)
    counts = {"tests": len(section.cases) + section.unclear, "failures": failing, "errors": int(section.unclear)}
    suite = Xml.SubElement(root, "testsuite", {"name": section.problem, **{k: str(v) for k, v in counts.items()}})
    if section.unclear:
        case = Xml.SubElement(suite, "testcase", classname=section.problem, name="baseline")
        Xml.SubElement(case, "error", message=section.headline).text = "\n".join(
            [*(cause.text for cause in section.causes), *section.remarks]
        )
    for one in section.cases:
        _case(suite, section.problem, one)


def _case(suite: Xml.Element, problem: str, case: Case) -> None:
    element = Xml.SubElement(suite, "testcase", classname=problem, name=case.controller)
    if case.changed:
        message = f"{len(case.changed)} of {len(case.lines)} metrics changed"
        Xml.SubElement(element, "failure", message=message).text = "\n".join(line.sentence for line in case.changed)
