"""Findings as a web page and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from reflfield.capture.capture import Capture
from reflfield.checking.findings import ERROR, NOTE, SEVERITIES, WARNING, Finding, Findings
from reflfield.report.page import (
    Figure,
    Item,
    KeyNumber,
    Note,
    Panel,
    ReportContent,
    Section,
    Table,
    encode_picture,
    write_report,
)
from reflfield.util.files import replacing
from reflfield.util.quoting import listed, printable

PAGE, DOCUMENT = "index.html", "check.json"
FORMAT, VERSION = "reflfield-check", 1
TITLES = {ERROR: "Errors", WARNING: "Warnings", NOTE: "Notes"}
INTROS = {
    ERROR: "They spoil the result: correct them first.",
    WARNING: "They may spoil the result: look at each.",
    NOTE: "Worth knowing; nothing must be done.",
}
# Findings with pictures on the page, per severity; the table and the JSON have all.
MOST_SHOWN = 40


def write_findings(folder: Path, capture: Capture, findings: Findings, seconds: float) -> Path:
    """Write the page and the document of a check; return the page's path."""
    folder.mkdir(parents=True, exist_ok=True)
    with replacing(folder / DOCUMENT) as partial:
        text = json.dumps(document(capture, findings, seconds), indent=1, ensure_ascii=False)
        partial.write_text(text + "\n", encoding="utf-8")
    write_report(folder / PAGE, content(capture, findings, seconds))
    return folder / PAGE


def document(capture: Capture, findings: Findings, seconds: float) -> dict[str, Any]:
    """What `check.json` holds."""
    return {
        "format": FORMAT,
        "version": VERSION,
        "capture": capture.name,
        "description": str(capture.description or capture.root),
        "worst": findings.worst or "nothing",
        "counts": {severity: findings.count(severity) for severity in SEVERITIES},
        "findings": [finding.entry() for finding in findings.all],
        "measured": findings.measured,
        "seconds": round(seconds, 2),
    }


def content(capture: Capture, findings: Findings, seconds: float) -> ReportContent:
    """What the page shows."""
    n = findings.measured
    numbers = [
        KeyNumber(TITLES[severity].lower(), str(findings.count(severity)))
        for severity in reversed(SEVERITIES)
    ]
    more = (
        KeyNumber("photographs", str(n["photographs"]), f"{n['views']} x {n['lights']}"),
        KeyNumber("time", f"{seconds:.1f} s"),
    )
    verdict = {
        ERROR: "It should not be processed before the errors are corrected.",
        WARNING: "It can be processed; look at the warnings first.",
    }.get(findings.worst, "Nothing is wrong with it, as far as this check can tell.")
    return ReportContent(
        title=f"Check of {printable(capture.name)}",
        subtitle=f"A {capture.format} capture, before anything is made of it. {verdict}",
        key_numbers=(*numbers, *more),
        sections=tuple(_sections(findings)),
    )


def _sections(findings: Findings) -> Iterable[Section]:
    if not findings.all:
        yield Section("Findings", "None.", ())
    for severity in reversed(SEVERITIES):
        some = [finding for finding in findings.all if finding.severity == severity]
        if some:
            items = [item for finding in some[:MOST_SHOWN] for item in _items(finding)]
            yield Section(TITLES[severity], INTROS[severity], (_table(some), *items))


def _table(findings: list[Finding]) -> Table:
    return Table(
        ("what", "where", "evidence", "what to do"),
        tuple((_title(f.kind), listed(list(f.subjects)), f.words, f.remedy) for f in findings),
        f"{len(findings)} in all.",
    )


def _items(finding: Finding) -> Iterable[Item]:
    """Pictures of a finding; findings without pictures stand in the table alone."""
    if not finding.pictures:
        return
    panels = tuple(
        Panel(encode_picture(picture.image), printable(picture.label))
        for picture in finding.pictures
    )
    title = f"{_title(finding.kind)}: {listed(list(finding.subjects))}"
    yield Figure(panels, f"{finding.words}; {finding.remedy}.", title=title)
    if finding.file:
        yield Note(printable(finding.file))


def _title(kind: str) -> str:
    return kind[:1].upper() + kind[1:]
