"""Checking a capture, from Python and by the command."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from reflfield.api.captures import open_capture
from reflfield.capture.capture import Capture
from reflfield.checking.capture_check import check_capture
from reflfield.checking.check_report import write_findings
from reflfield.checking.findings import Findings

_reader_log = logging.getLogger("reflfield.capture.readers")


def check(
    capture: Capture | Path | str,
    out: Path | str,
    *,
    format: str | None = None,
    encoding: str | None = None,
    layer: str | None = None,
    follow_links: bool = False,
) -> Findings:
    """Find what is wrong with a capture, before anything is made of it.

    Every photograph is decoded once; nothing is changed.

    Parameters
    ----------
    capture : Capture, Path or str
        What `open_capture` would refuse of photographs and their pairs is a finding here.
    out : Path or str
        Folder for ``index.html`` and ``check.json``; created.
    format, encoding, layer, follow_links
        As of `open_capture`.

    Returns
    -------
    Findings
        ``findings.worst`` is the gravest severity; ``findings.all`` has them, each with its
        ``kind``, ``severity``, ``subjects``, ``words``, ``remedy`` and ``file``.

    Raises
    ------
    CaptureError
        If there is no description, or it cannot be understood.
    """
    started = time.perf_counter()
    if not isinstance(capture, Capture):
        capture = _opened(capture, format, encoding, layer, follow_links)
    findings = check_capture(capture)
    write_findings(Path(out), capture, findings, time.perf_counter() - started)
    return findings


def _opened(
    path: Path | str,
    format: str | None,
    encoding: str | None,
    layer: str | None,
    follow_links: bool,
) -> Capture:
    """The capture; its notes are findings, and not said twice."""
    _reader_log.addFilter(_silent)
    try:
        return open_capture(
            path,
            format,
            encoding=encoding,
            layer=layer,
            require_photographs=False,
            follow_links=follow_links,
        )
    finally:
        _reader_log.removeFilter(_silent)


def _silent(record: logging.LogRecord) -> bool:
    return False
