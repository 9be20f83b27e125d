"""Small charts as SVG text, which pages and Markdown both show."""

from collections.abc import Mapping, Sequence
from xml.sax.saxutils import escape

_COLORS = ("#4269d0", "#efb118", "#ff725c", "#6cc5b0", "#3ca951", "#ff8ab7", "#a463f2", "#97bbf5")
_WIDTH, _LEFT, _RIGHT, _LINE, _AXIS = 720.0, 220.0, 70.0, 24.0, 50.0
_STYLE = (
    "<style>text{font:12px sans-serif;fill:#333}.axis{stroke:#999}"
    "@media(prefers-color-scheme:dark){text{fill:#ddd}}</style>"
)


def bar_chart(title: str, bars: Sequence[tuple[str, float, float, float]]) -> str:
    """Draw one bar a method with the ends of its interval.

    Args:
        title: What is shown, unit included.
        bars: For each method its name, its mean, and the low and high end of its interval.
    """
    height = _LINE * (len(bars) + 2)
    most = max([high for *_, high in bars] + [mean for _, mean, *_ in bars]) or 1.0
    scale = (_WIDTH - _LEFT - _RIGHT) / most
    parts: list[str] = []
    for number, (name, mean, low, high) in enumerate(bars):
        y = _LINE * (number + 1.6)
        end, middle = _LEFT + scale * mean, y + 7
        parts += [
            _text(_LEFT - 8, y + 11, name, anchor="end"),
            f'<rect x="{_LEFT}" y="{y:.1f}" width="{scale * mean:.1f}" height="14" '
            f'fill="{_COLORS[number % len(_COLORS)]}"/>',
            _segment(_LEFT + scale * low, middle, _LEFT + scale * high, middle),
            _text(max(end, _LEFT + scale * high) + 6, y + 11, f"{mean:.2f}"),
        ]
    return _drawing(title, height, parts)


def line_chart(title: str, lines: Mapping[str, Sequence[float | None]]) -> str:
    """Draw one line a method over the frames; where a value is unknown the line is broken.

    Args:
        title: What is shown, unit included.
        lines: For each method its values, frame by frame.
    """
    top, bottom = 40.0, 240.0
    known = [value for line in lines.values() for value in line if value is not None]
    most = max(known, default=0.0) or 1.0
    count = max(len(line) for line in lines.values())
    across = (_WIDTH - _AXIS - _LEFT) / max(1, count - 1)
    parts = [
        _segment(_AXIS, bottom, _WIDTH - _LEFT, bottom),
        _segment(_AXIS, top, _AXIS, bottom),
        _text(_AXIS - 6, top + 4, f"{most:.3g}", anchor="end"),
        _text(_AXIS - 6, bottom + 4, "0", anchor="end"),
        _text(_WIDTH - _LEFT, bottom + 18, f"frame {count - 1}", anchor="end"),
    ]
    for number, (name, line) in enumerate(lines.items()):
        color = _COLORS[number % len(_COLORS)]
        pen, path = "M", ""
        for frame, value in enumerate(line):
            if value is None:
                pen = "M"
                continue
            x, y = _AXIS + across * frame, bottom - (bottom - top) * value / most
            path += f"{pen}{x:.1f} {y:.1f}"
            pen = "L"
        parts.append(f'<path d="{path}" fill="none" stroke="{color}" stroke-width="1.6"/>')
        at = top + 18 * number
        parts.append(
            f'<rect x="{_WIDTH - _LEFT + 12}" y="{at}" width="10" height="10" fill="{color}"/>'
        )
        parts.append(_text(_WIDTH - _LEFT + 28, at + 10, name))
    return _drawing(title, max(bottom + 30, top + 18 * len(lines)), parts)


def _drawing(title: str, height: float, parts: Sequence[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH:g} {height:g}" '
        f'role="img" aria-label="{escape(title, {chr(34): "&quot;"})}">{_STYLE}'
        f"{_text(8.0, 16.0, title)}{''.join(parts)}</svg>\n"
    )


def _text(x: float, y: float, text: str, *, anchor: str = "start") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'


def _segment(x0: float, y0: float, x1: float, y1: float) -> str:
    return f'<line class="axis" x1="{x0:.1f}" y1="{y0:.1f}" x2="{x1:.1f}" y2="{y1:.1f}"/>'
