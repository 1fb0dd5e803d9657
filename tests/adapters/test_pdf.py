"""Pages on paper: the same bytes, nothing fetched, nothing left out in silence, and plain words without Pango."""

from __future__ import annotations

import base64
import hashlib
import os
import re
import subprocess
import sys
import zlib
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from threading import Thread

import numpy as np
import pytest

from pipeline.adapters import system_packages
from pipeline.adapters.pdf import pdf
from pipeline.adapters.pictures import blank, png

CHECKOUT = Path(__file__).resolve().parents[2]
PICTURE = base64.b64encode(png(blank(8, 6))).decode()
STYLE = "@page { size: A4; @bottom-right { content: counter(page) ' of ' counter(pages) } }"


def document(body: str, style: str = STYLE) -> str:
    head = f"<meta charset='utf-8'><title>Knee Δ</title><style>{style}</style>"
    return f"<!DOCTYPE html><html lang='en'><head>{head}</head><body>{body}</body></html>"


def elsewhere(code: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """A fresh process that knows ``pdf`` and ``EnvironmentFault``."""
    prepared = f"from pipeline.adapters.pdf import pdf\nfrom pipeline.errors import EnvironmentFault\n{code}"
    return subprocess.run(
        [sys.executable, "-c", prepared],
        cwd=CHECKOUT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )


def objects(data: bytes) -> bytes:
    """The file with what is compressed in it, readable."""
    streams = re.findall(rb"stream\r?\n(.*?)\r?\nendstream", data, re.DOTALL)
    return data + b"\n".join(zlib.decompress(one) for one in streams if one[:1] == b"\x78")


def test_the_same_page_gives_the_same_bytes_in_every_process() -> None:
    text = document(f'<p>Δ → 12°</p><img alt="" src="data:image/png;base64,{PICTURE}">')
    made = pdf(text)
    assert made == pdf(text)
    assert made != pdf(text.replace("12", "13"))
    code = f"import hashlib; print(hashlib.sha256(pdf({text!r})).hexdigest())"
    assert elsewhere(code, PYTHONHASHSEED="7").stdout.strip() == hashlib.sha256(made).hexdigest()


def test_it_is_made_to_be_kept_and_says_what_it_is_but_not_when() -> None:
    data = objects(pdf(document("<p>one</p><p style='break-before: page'>two</p>")))
    assert data.startswith(b"%PDF-1.7")
    assert len(re.findall(rb"/Type */Page\b", data)) == 2
    assert b'pdfaid:part="3" pdfaid:conformance="B"' in data
    assert b"/OutputIntents" in data
    assert re.search(rb"/Lang *\(en\)", data)
    assert '<rdf:li xml:lang="x-default">Knee Δ</rdf:li>'.encode() in data
    assert not re.search(rb"CreationDate|ModDate|CreateDate|ModifyDate", data)


def test_a_picture_goes_in_point_by_point() -> None:
    values = np.arange(8 * 6 * 3, dtype=np.uint8).reshape(6, 8, 3)
    source = base64.b64encode(png(values)).decode()
    data = pdf(document(f'<img alt="" src="data:image/png;base64,{source}">'))
    assert b"/Width 8" in data
    assert b"/Height 6" in data
    assert objects(data).count(b"/Subtype /Image") == 1


@pytest.fixture
def server() -> Iterator[tuple[str, list[str]]]:
    """Address of a server on this machine, and the paths it was asked for."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    with HTTPServer(("127.0.0.1", 0), Handler) as one:
        thread = Thread(target=one.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{one.server_port}", asked
        one.shutdown()
        thread.join()


REFUSED = "the page asks for something outside of it|the page cannot be printed: (Failed to render SVG|Relative URI)"
ASKING = {
    "img": '<img alt="" src="{}">',
    "style": '<p style="background: url({})">x</p>',
    "sheet": '<link rel="stylesheet" href="{}">',
    "import": '<style>@import "{}";</style>',
    "font": "<style>@font-face {{ font-family: x; src: url({}) }} p {{ font-family: x }}</style><p>x</p>",
    "object": '<object data="{}"></object>',
    "embed": '<embed src="{}">',
    "svg": '<svg width="9" height="9"><image href="{}" width="9" height="9"/></svg>',
    "attachment": '<link rel="attachment" href="{}">',
}


@pytest.mark.parametrize("way", ASKING)
def test_nothing_is_asked_of_the_network(way: str, server: tuple[str, list[str]]) -> None:
    address, asked = server
    with pytest.raises(ValueError, match=REFUSED):
        pdf(document(ASKING[way].format(f"{address}/secret.png")))
    assert asked == []


@pytest.mark.parametrize("way", ASKING)
def test_no_file_is_read(way: str, tmp_path: Path) -> None:
    secret = tmp_path / "secret.png"
    secret.write_bytes(png(blank(8, 6)))
    with pytest.raises(ValueError, match=REFUSED):
        pdf(document(ASKING[way].format(secret.as_uri())))


def test_a_relative_address_leads_nowhere() -> None:
    with pytest.raises(ValueError, match=REFUSED):
        pdf(document('<img alt="" src="images/poses.png">'))


def test_a_picture_that_cannot_be_read_is_not_left_out_in_silence() -> None:
    with pytest.raises(ValueError, match="the page cannot be printed: Failed to load image"):
        pdf(document('<img alt="" src="data:image/png;base64,AAAA">'))


CATCH = "try:\n    pdf('<p>x</p>')\nexcept EnvironmentFault as error:\n    print(error)"


def test_without_pango_it_says_what_to_install() -> None:
    code = f"import cffi\ndef none(*_): raise OSError('no such library')\ncffi.FFI.dlopen = none\n{CATCH}"
    said = elsewhere(code).stdout
    assert said.startswith("E-ENV-12 This machine cannot write report.pdf: ")
    assert "libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0 fonts-dejavu-core" in said
    assert "courtbouillon" not in said


def test_without_any_font_it_says_so_and_does_not_crash(tmp_path: Path) -> None:
    nothing = tmp_path / "fonts.conf"
    nothing.write_text("<fontconfig></fontconfig>")
    assert elsewhere(CATCH, FONTCONFIG_FILE=str(nothing)).stdout.startswith("E-ENV-12 ")


def test_the_same_packages_are_named_wherever_they_are_installed() -> None:
    packages = (*system_packages.RENDERER, *system_packages.TEXT)
    for name in ("tools/setup.sh", "Dockerfile"):
        text = (CHECKOUT / name).read_text()
        assert [package for package in packages if package not in text] == []
