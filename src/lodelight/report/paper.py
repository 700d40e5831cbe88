"""Pages of black boxes and text at true size, as PDF and SVG. Millimetres from the top left, y downwards."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from html import escape

PT_PER_MM = 72.0 / 25.4
SIZES_MM = {
    "a5": (148.0, 210.0), "a4": (210.0, 297.0), "a3": (297.0, 420.0), "a2": (420.0, 594.0), "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0), "letter": (215.9, 279.4),
}  # fmt: skip
# Widths of Helvetica's characters, thousandths of its size, from the blank on; the mean for the others.
WIDTHS = [278, 278, 355, 556, 556, 889, 667, 191, 333, 333, 389, 584, 278, 333, 278, 278] + [556] * 10
MEAN_WIDTH = 560


@dataclass(eq=False)
class Page:
    """width_mm, height_mm; boxes (x, y, w, h); texts (x, y of the baseline, height of capitals over .72, text)"""

    width_mm: float
    height_mm: float
    boxes: list[tuple[float, float, float, float]] = field(default_factory=list)
    texts: list[tuple[float, float, float, str]] = field(default_factory=list)

    def box(self, x: float, y: float, w: float, h: float) -> None:
        self.boxes.append((x, y, w, h))

    def text(self, x: float, y: float, size_mm: float, text: str, middle: bool = False) -> None:
        """middle : x is where its middle shall be, about"""
        clean = " ".join(text.split())
        self.texts.append((x - 0.5 * text_width_mm(clean, size_mm) if middle else x, y, size_mm, clean))


def text_width_mm(text: str, size_mm: float) -> float:
    """About how wide a text is."""
    units = [WIDTHS[ord(c) - 32] if 32 <= ord(c) < 32 + len(WIDTHS) else MEAN_WIDTH for c in text]
    return sum(units) * 1e-3 * size_mm


def to_pdf(pages: Sequence[Page]) -> bytes:
    """A PDF 1.4 file with the standard font Helvetica; what Latin-1 lacks becomes a question mark."""
    n = len(pages)
    kids = " ".join(f"{4 + 2 * i} 0 R" for i in range(n))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",  # print at true size
        f"<< /Type /Pages /Kids [{kids}] /Count {n} >>".encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
    ]
    for i, page in enumerate(pages):
        box = f"0 0 {page.width_mm * PT_PER_MM:.3f} {page.height_mm * PT_PER_MM:.3f}"
        objects.append(
            f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Resources << /Font << /F1 3 0 R >> >> "
            f"/Contents {5 + 2 * i} 0 R >>".encode()
        )
        content = zlib.compress(_content(page))
        objects.append(
            b"<< /Length %d /Filter /FlateDecode >>\nstream\n" % len(content) + content + b"\nendstream"
        )  # fmt: skip
    out = b"%PDF-1.4\n%\xe2\xe3\xcf\xd3\n"
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(out))
        out += b"%d 0 obj\n" % number + body + b"\nendobj\n"
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    tail = b"xref\n0 %d\n0000000000 65535 f \n" % (len(objects) + 1) + table
    tail += b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (len(objects) + 1, len(out))
    return out + tail


def _content(page: Page) -> bytes:
    k, H = PT_PER_MM, page.height_mm
    rows = ["0 g"]
    rows += [f"{x * k:.4f} {(H - y - h) * k:.4f} {w * k:.4f} {h * k:.4f} re" for x, y, w, h in page.boxes]
    rows.append("f")
    body = "\n".join(rows).encode() if page.boxes else b"0 g"
    for x, y, size, text in page.texts:
        shown = text.encode("cp1252", "replace")
        for special in (b"\\", b"(", b")"):
            shown = shown.replace(special, b"\\" + special)
        body += f"\nBT /F1 {size * k:.3f} Tf {x * k:.3f} {(H - y) * k:.3f} Td (".encode() + shown + b") Tj ET"
    return body


def to_svg(page: Page) -> str:
    """An SVG file of one page."""
    w, h = page.width_mm, page.height_mm
    boxes = "".join(f"M{x:.4f} {y:.4f}h{bw:.4f}v{bh:.4f}h{-bw:.4f}z" for x, y, bw, bh in page.boxes)
    texts = "\n".join(
        f'<text x="{x:.3f}" y="{y:.3f}" font-size="{size:.3f}">{escape(text)}</text>' for x, y, size, text in page.texts
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{w:g}mm" height="{h:g}mm" viewBox="0 0 {w:g} {h:g}" '
        f'font-family="Helvetica, Arial, sans-serif">\n<rect width="{w:g}" height="{h:g}" fill="#fff"/>\n'
        f'<path d="{boxes}" shape-rendering="crispEdges"/>\n{texts}\n</svg>\n'
    )
