"""A result in a notebook: its name, scores and one picture, in a few lines of HTML."""

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from markupsafe import Markup
from PIL import Image

SCORE_LABELS: Mapping[str, str] = {
    "held_per_km2": "vehicles held per km²",
    "completeness": "completeness of all movers",
    "completeness_visible": "completeness of visible vehicles",
    "custody": "custody",
    "false_per_km2": "false tracks per km²",
    "purity": "track purity",
    "median_time_to_loss_s": "median time to loss [s]",
    "same_track_after_10s": "P(same id after 10 s)",
    "idf1_moving": "IDF1 of moving vehicles",
    "false_per_epoch": "false tracks a frame",
    "identity_switches": "identity switches",
}
_SIDE = 640  # longest side of a card's picture [pixel]
_DASH = "–"
_HEAD = Markup('<div style="max-width:{}px"><strong>{}</strong>')
_NOTE = Markup('<div style="border-left:4px solid #c25000;padding-left:8px">{}</div>')
_VERDICT = Markup("<p>{}</p>")
_PICTURE = Markup('<img alt="{}" src="{}" style="width:100%;height:auto">')
_END = Markup(
    "<div>in <code>{}</code>; arrays: <code>.tree</code>, a page: <code>glintrack report</code></div></div>"
)


def score_text(value: float | None) -> str:
    """A score to three digits, a dash where there is none."""
    return _DASH if value is None or value != value else f"{value:.3g}"


def score_rows(scores: Mapping[str, Mapping[str, float | None]]) -> list[tuple[str, list[str]]]:
    """One row a score, one column a channel, of the scores of each channel."""
    if not scores:
        return []
    return [
        (label, [score_text(of.get(key)) for of in scores.values()]) for key, label in SCORE_LABELS.items()
    ]


def embedded(path: Path, longest_side: int) -> str:
    """A picture file as the address of a small WebP."""
    with Image.open(path) as picture:
        shown = picture.convert("RGB")
    shown.thumbnail((longest_side, longest_side))
    buffer = io.BytesIO()
    shown.save(buffer, "WEBP", quality=80)
    return "data:image/webp;base64," + base64.b64encode(buffer.getvalue()).decode()


def card_html(
    title: str,
    folder: Path,
    answer: tuple[str, Mapping[str, Mapping[str, float | None]]],
    notes: Sequence[str],
    picture: Path | None,
) -> str:
    """HTML of a result without program or style sheet; all text of the result is escaped.

    Parameters
    ----------
    title, folder
        What it is called and where it lies.
    answer
        The verdict, and the scores of each channel by the keys of `SCORE_LABELS`.
    notes
        What is missing or odd.
    picture
        A picture file, or None.
    """
    verdict, scores = answer
    parts = [_HEAD.format(_SIDE, title), *(_NOTE.format(note) for note in notes)]
    if verdict:
        parts.append(_VERDICT.format(verdict))
    if scores:
        heads = Markup("").join(Markup("<th>{}</th>").format(name) for name in scores)
        rows = Markup("").join(
            Markup('<tr><th style="text-align:left;font-weight:normal">{}</th>{}</tr>').format(
                label, Markup("").join(Markup("<td>{}</td>").format(v) for v in values)
            )
            for label, values in score_rows(scores)
        )
        parts.append(Markup("<table><tr><th></th>{}</tr>{}</table>").format(heads, rows))
    if picture is not None:
        parts.append(_PICTURE.format(f"tracks of {title}", embedded(picture, _SIDE)))
    return "".join([*parts, _END.format(str(folder))])
