"""A figure of matplotlib as a small `svg` element that can stand inside a page."""

from __future__ import annotations

import base64
import io
import re
import zlib
from collections import Counter
from collections.abc import Iterator
from html import escape

RASTER_COLORS = 32
"""Colors of a rasterized part: half a dozen colors of curves with their smooth edges."""

DECIMALS = re.compile(r"-?\d+\.\d+")
NO_ROTATION = re.compile(r' transform="rotate\(-?0 [^"]*"')
SYMBOL = re.compile(r'(id="|#)(m[0-9a-f]{8,})\b')
TAG = re.compile(r"<g(?: [^>]*[^/>])?>|</g>")
COORDINATES = re.compile(r'\b(?:d|x|y|width|height|transform|points)="[^"]*"')
UNUSED_ID = re.compile(
    r' id="(?:figure|axes|patch|line2d|text|matplotlib\.axis|xtick|ytick|legend|Line|Fill|image)[^"]*"'
)


RASTER = re.compile(r"data:image/png;base64,([A-Za-z0-9+/=\s]+)")


def _short_number(match: re.Match[str]) -> str:
    """Return a coordinate to a tenth of a point; factors of scale keep three digits."""
    value = float(match.group())
    return f"{value:.3g}" if abs(value) < 1 else f"{value:.1f}".removesuffix(".0")


def _prefix(name: str) -> str:
    """Return a short name for the classes and symbols of one picture."""
    return f"p{zlib.crc32(name.encode()):x}-"


def _without_plain_groups(text: str) -> Iterator[str]:
    """Yield the text without groups that have no attribute."""
    is_kept: list[bool] = []
    place = 0
    for tag in TAG.finditer(text):
        yield text[place : tag.start()]
        place = tag.end()
        if tag.group() != "</g>":
            is_kept.append(tag.group() != "<g>")
            shown = is_kept[-1]
        else:
            shown = is_kept.pop()
        if shown:
            yield tag.group()
    yield text[place:]


STYLE = re.compile(r' style="([^"]*)"')


def _share_styles(text: str, name: str) -> str:
    """Replace styles that several elements have by classes named after the picture."""
    counts = Counter(STYLE.findall(text))
    shared = [style for style, count in counts.items() if count > 2]
    classes = {style: f"{_prefix(name)}{i}" for i, style in enumerate(shared)}
    text = STYLE.sub(lambda m: f' class="{classes[m.group(1)]}"' if m.group(1) in classes else m.group(), text)
    rules = "".join(f".{classes[style]}{{{style}}}" for style in shared)
    return text.replace("</svg>", f"<style>{rules}</style></svg>") if shared else text


def _shrink_raster(code: str) -> str:
    """Return an embedded PNG with a palette in place of four bytes a pixel."""
    from PIL import Image

    buffer = io.BytesIO()
    with Image.open(io.BytesIO(base64.b64decode(code))) as image:
        reduced = image.convert("RGBA").quantize(
            RASTER_COLORS, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE
        )
        reduced.save(buffer, "png", optimize=True)
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode('ascii')}"


def inline_svg(text: str, name: str, description: str) -> str:
    """The `svg` element alone: no prologue, metadata or unused ids; coordinates to tenths of a point."""
    text = text[text.index("<svg") :]
    text = re.sub(r"\s*<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r"<!--.*?-->\s*", "", text)
    text = UNUSED_ID.sub("", text)
    text = RASTER.sub(lambda match: _shrink_raster(match.group(1)), text)
    text = COORDINATES.sub(lambda match: DECIMALS.sub(_short_number, match.group()), text)
    text = re.sub(r'\s+"', '"', re.sub(r"\s+", " ", "".join(_without_plain_groups(_share_styles(text, name)))))
    text = re.sub(r"> <", "><", NO_ROTATION.sub("", text))
    text = SYMBOL.sub(lambda match: f"{match.group(1)}{_prefix(name)}{match.group(2)[-5:]}", text)
    box = re.search(r'viewBox="0 0 ([\d.]+) ([\d.]+)"', text)
    assert box is not None
    width = 4.0 / 3.0 * float(box.group(1))
    opening = f'<svg viewBox="{box.group(0)[9:-1]}" style="width:{width:.0f}px" role="img"'
    names = ' xmlns:xlink="http://www.w3.org/1999/xlink" xmlns="http://www.w3.org/2000/svg"'
    return f'{opening} aria-label="{escape(description)}"{names}>{text[text.index(">") + 1 :]}'
