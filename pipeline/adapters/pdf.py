"""A page as PDF, with WeasyPrint and Pango; nothing is fetched, and the same page gives the same bytes."""

from __future__ import annotations

import contextlib
import functools
import hashlib
import io
import logging
import warnings
from collections.abc import Iterator
from typing import Any

from pipeline.adapters.system_packages import INSTALL_TEXT
from pipeline.errors import EnvironmentFault

#: For long keeping, with what shows it (colour profile, fonts) inside.
VARIANT = "pdf/a-3b"


def pdf(html: str) -> bytes:
    """The pages of a printed HTML document that brings its pictures along as ``data:`` addresses.

    Parameters
    ----------
    html : str
        Its style for paper is that of ``@media print`` and ``@page``; title and language go into the metadata.

    Returns
    -------
    bytes
        PDF/A-3b, without a date; the identifier is made from the text.

    Raises
    ------
    ValueError
        When the document asks for an address other than ``data:``, or one of its pictures cannot be read.
    EnvironmentFault
        ``E-ENV-12`` when a system library or every font is missing.
    """
    weasyprint = _weasyprint()
    from weasyprint.urls import FatalURLFetchingError, URLFetcher  # noqa: PLC0415 - as above

    fetcher = URLFetcher(allowed_protocols=("data",), allow_redirects=False, fail_on_errors=True)
    identifier = hashlib.sha256(html.encode()).hexdigest().encode()
    try:
        with _errors_raised(), warnings.catch_warnings():
            # the profile of colours is opened and left to the garbage collector
            warnings.simplefilter("ignore", ResourceWarning)
            document = weasyprint.HTML(string=html, url_fetcher=fetcher, base_url="data:,")
            made = document.write_pdf(pdf_variant=VARIANT, pdf_identifier=identifier)
    except FatalURLFetchingError as error:
        raise ValueError(f"the page asks for something outside of it: {str(error)[:200]}") from None
    return bytes(made)


@functools.cache
def _weasyprint() -> Any:
    """The package, which prints advice where it finds no Pango, warns where it finds no font, and then crashes."""
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
            warnings.filterwarnings("error", message="No fonts|FontConfig|HarfBuzz")
            import weasyprint  # noqa: PLC0415 - a cached run does not need it
    except (OSError, Warning) as error:
        raise EnvironmentFault(
            "E-ENV-12",
            "This machine cannot write report.pdf: a library that sets text (Pango, HarfBuzz) is missing, or any font.",
            f"Install them: {INSTALL_TEXT}",
        ) from error
    return weasyprint


@contextlib.contextmanager
def _errors_raised() -> Iterator[None]:
    """What WeasyPrint only logs as an error, such as a picture that it leaves out, is an error."""
    said = _Errors()
    logger = logging.getLogger("weasyprint")
    logger.addHandler(said)
    try:
        yield
    finally:
        logger.removeHandler(said)
    if said.messages:
        raise ValueError(f"the page cannot be printed: {said.messages[0]}")


class _Errors(logging.Handler):
    """Keeps what is logged as an error."""

    def __init__(self) -> None:
        super().__init__(logging.ERROR)
        self.messages: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())
