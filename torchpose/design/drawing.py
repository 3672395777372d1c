"""A page of circles, rectangles, lines and text in mm, written as SVG or PDF at true scale.

Both writers are our own so that a circle stays a circle (SVG) or eight cubic arcs within 5e-6 of its radius (PDF,
which knows no circle), and a length on the page is the number in the file.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from xml.sax.saxutils import escape

_POINTS = 72 / 25.4  # a mm, the unit of PDF
_HAIR = 1e-4  # mm less of page: rasters are rounded up to whole pixels, and pictures stretched to fill them
_ARCS = 8  # of a circle
_DIGIT = 0.556  # width of a digit of Helvetica over its size (Adobe font metrics)


@dataclass(frozen=True)
class Circle:
    """Filled disc, mm; ``grey`` from 0 (black) to 1, as everywhere here."""

    x: float
    y: float
    radius: float
    grey: float


@dataclass(frozen=True)
class Rectangle:
    """Filled rectangle with its upper left corner at x, y, mm."""

    x: float
    y: float
    width: float
    height: float
    grey: float


@dataclass(frozen=True)
class Line:
    """Straight line of ``width`` mm with flat ends."""

    x1: float
    y1: float
    x2: float
    y2: float
    width: float = 0.1
    grey: float = 0.0


@dataclass(frozen=True)
class Text:
    """Text of ``size`` mm from its baseline's start at x, y; ``number`` centres a text of digits on x."""

    x: float
    y: float
    size: float
    text: str
    number: bool = False


@dataclass(frozen=True)
class Window:
    """What lies in a rectangle with its upper left corner at x, y of shapes that are moved by ``dx``, ``dy``, mm."""

    x: float
    y: float
    width: float
    height: float
    dx: float
    dy: float
    shapes: "list[Shape]"


Shape = Circle | Rectangle | Line | Text | Window


@dataclass(frozen=True)
class Page:
    """Shapes in the order of drawing on a white page, x to the right, y down, mm.

    ``trim``: x, y, width and height of what is cut out.
    """

    title: str
    width: float
    height: float
    trim: tuple[float, float, float, float]
    shapes: list[Shape]

    def svg(self) -> str:
        """The page as SVG 1.1; one user unit is a mm."""
        width, height = _number(self.width), _number(self.height)
        lines = [
            f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}mm" height="{height}mm" '
            f'viewBox="0 0 {width} {height}">',
            _element("title", self.title),
            _element("rect", width=self.width, height=self.height, fill="#ffffff"),
            *map(_svg, self.shapes),
            "</svg>\n",
        ]
        return "\n".join(lines)

    def pdf(self) -> bytes:
        """The page as PDF 1.6, with the trim box of the printer's trade and the wish not to be scaled."""
        return pdf_of([self])

    def _pdf_parts(self) -> tuple[str, bytes]:
        """Boxes and content of the page."""
        # from here on y down and mm
        flip = f"{_number(_POINTS)} 0 0 {_number(-_POINTS)} 0 {_number(self.height * _POINTS)} cm"
        content = "\n".join([flip, *map(_pdf, self.shapes)]).encode("cp1252", "replace")
        x, y, width, height = self.trim
        media = [0.0, 0.0, self.width - _HAIR, self.height - _HAIR]
        trim = [x, self.height - y - height, x + width, self.height - y]
        boxes = [" ".join(_number(v * _POINTS) for v in box) for box in (media, trim)]
        return f"/MediaBox [{boxes[0]}] /TrimBox [{boxes[1]}]", content


def pdf_of(pages: Sequence[Page]) -> bytes:
    """A document of pages under the title of the first, see `Page.pdf`."""
    font = 3 + 2 * len(pages)
    kids = " ".join(f"{3 + 2 * k} 0 R" for k in range(len(pages)))
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        f"<< /Type /Pages /Kids [{kids}] /Count {len(pages)} >>".encode(),
    ]
    for page in pages:
        boxes, content = page._pdf_parts()
        objects += [
            f"<< /Type /Page /Parent 2 0 R {boxes} /Contents {len(objects) + 2} 0 R "
            f"/Resources << /Font << /F {font} 0 R >> >> >>".encode(),
            b"<< /Length %d >>\nstream\n%s\nendstream" % (len(content), content),
        ]
    title = _pdf_string(pages[0].title).encode("cp1252", "replace")
    objects += [
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Title (%s) /Creator (torchpose) >>" % title,
    ]
    file = b"%PDF-1.6\n%\xe2\xe3\xcf\xd3\n"
    offsets = []
    for number, body in enumerate(objects, 1):
        offsets.append(len(file))
        file += b"%d 0 obj\n%s\nendobj\n" % (number, body)
    table = b"".join(b"%010d 00000 n \n" % offset for offset in offsets)
    size, start = len(objects) + 1, len(file)
    file += b"xref\n0 %d\n0000000000 65535 f \n%s" % (size, table)
    return file + b"trailer\n<< /Size %d /Root 1 0 R /Info %d 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (
        size,
        size - 1,
        start,
    )


def _number(value: float) -> str:
    return f"{value:.9f}".rstrip("0").rstrip(".") if value % 1 else f"{value:.0f}"


def _numbers(*values: float) -> str:
    return " ".join(map(_number, values))


def _element(name: str, text: str | None = None, /, **attributes: float | str) -> str:
    values = {key.replace("_", "-"): v if isinstance(v, str) else _number(v) for key, v in attributes.items()}
    start = " ".join([name, *(f'{key}="{value}"' for key, value in values.items())])
    return f"<{start}/>" if text is None else f"<{start}>{escape(text)}</{name}>"


def _svg(shape: Shape) -> str:
    if isinstance(shape, Window):
        box = _numbers(shape.x - shape.dx, shape.y - shape.dy, shape.width, shape.height)
        place = " ".join(f'{key}="{_number(getattr(shape, key))}"' for key in ("x", "y", "width", "height"))
        return "\n".join([f'<svg {place} viewBox="{box}">', *map(_svg, shape.shapes), "</svg>"])
    if isinstance(shape, Text):
        family, anchor = "Helvetica, Arial, sans-serif", {"text_anchor": "middle"} if shape.number else {}
        return _element("text", shape.text, x=shape.x, y=shape.y, font_size=shape.size, font_family=family, **anchor)
    colour = f"#{round(255 * shape.grey):02x}" + 2 * f"{round(255 * shape.grey):02x}"
    if isinstance(shape, Circle):
        return _element("circle", cx=shape.x, cy=shape.y, r=shape.radius, fill=colour)
    if isinstance(shape, Rectangle):
        return _element("rect", x=shape.x, y=shape.y, width=shape.width, height=shape.height, fill=colour)
    return _element("line", x1=shape.x1, y1=shape.y1, x2=shape.x2, y2=shape.y2, stroke=colour, stroke_width=shape.width)


def _pdf(shape: Shape) -> str:
    if isinstance(shape, Window):
        clip = f"{_numbers(shape.x, shape.y, shape.width, shape.height)} re W n"
        move = f"1 0 0 1 {_numbers(shape.dx, shape.dy)} cm"
        return "\n".join([f"q {clip} {move}", *map(_pdf, shape.shapes), "Q"])
    if isinstance(shape, Text):
        x = shape.x - (_DIGIT * shape.size * len(shape.text) / 2 if shape.number else 0)
        return (
            f"BT /F {_numbers(shape.size)} Tf 0 g 1 0 0 -1 {_numbers(x, shape.y)} Tm ({_pdf_string(shape.text)}) Tj ET"
        )
    grey = _number(shape.grey)
    if isinstance(shape, Circle):
        return f"{grey} g {_pdf_circle(shape)} f"
    if isinstance(shape, Rectangle):
        return f"{grey} g {_numbers(shape.x, shape.y, shape.width, shape.height)} re f"
    path = f"{_numbers(shape.x1, shape.y1)} m {_numbers(shape.x2, shape.y2)} l S"
    return f"{grey} G {_number(shape.width)} w {path}"


def _pdf_circle(circle: Circle) -> str:
    turn = 2 * math.pi / _ARCS
    handle = 4 / 3 * math.tan(turn / 4)  # of cubic arcs that touch the circle at both ends and in the middle

    def at(angle: float, along: float) -> tuple[float, float]:
        c, s = math.cos(angle), math.sin(angle)
        return circle.x + circle.radius * (c - along * s), circle.y + circle.radius * (s + along * c)

    words = [f"{_numbers(*at(0, 0))} m"]
    for k in range(_ARCS):
        start, end = k * turn, (k + 1) * turn
        words.append(f"{_numbers(*at(start, handle), *at(end, -handle), *at(end, 0))} c")
    return " ".join(words)


def _pdf_string(text: str) -> str:
    return text.replace("\\", "\\\\").replace("(", "\\(").replace(")", "\\)")
