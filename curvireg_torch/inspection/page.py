"""The report of a mesh as one HTML page with pictures, and as lines of text."""

import html
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import torch

from ..registration import Registrar
from ..registration.confidence import two_decimals
from ..utils.arrays import Bytes
from ..visualization.contours import Drawn, draw_close_up
from ..visualization.encoding import embedded, jpeg, to_uint8
from .facts import CONTINUOUS_TURN, MeshFacts
from .look_alikes import LookAlike
from .report import ELEVATIONS, PIXELS_ACROSS, Inspection
from .trial import Expected, Outcome

MOST_PAIRS = 6
FEW_PAIRS = 2  # where none is alike
MOST_CONFUSIONS = 6
PICTURE_SIDE = 224  # px

_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>curvireg inspect: {title}</title><style>
body {{ font: 16px/1.5 system-ui, sans-serif; max-width: 60rem; margin: 2rem auto; padding: 0 1rem; color: #222 }}
table {{ border-collapse: collapse }} td, th {{ border: 1px solid #ccc; padding: .2rem .6rem; text-align: left }}
figure {{ display: inline-block; margin: .5rem; vertical-align: top; max-width: 26rem }}
img {{ height: 12rem; background: #eee }} .warning {{ border-left: 4px solid #d90; padding-left: .6rem }}
</style></head><body><h1>{title}</h1>
{body}
</body></html>
"""  # noqa: E501


def report_lines(report: Inspection) -> list[str]:
    """The report as lines of text for a terminal."""
    facts = report.facts
    lines = [f"{name}: {value}" for name, value in _fact_rows(facts)]
    if report.pairs:
        lines.append(f"look-alikes: from {len(report.alike)} of {len(report.pairs)} directions")
    if report.trial is not None:
        lines.append(f"expected: {_in_words(report.trial.expected)}")
        for name, (before, after) in report.trial.compared.items():
            change = (
                f"right {before.right:.2f} -> {after.right:.2f}, reliable {before.reliable:.2f} -> "
            )
            lines.append(f"  {name}: {change}{after.reliable:.2f} ({before.n} photographs)")
    lines += [f"warning: {text}" for text in report.warnings]
    return lines


def report_page(report: Inspection, *, title: str) -> str:
    """The report as an HTML page.

    Args:
        report: of the mesh; without its registrar, the page has no pictures.
        title: name of the mesh.
    """
    parts = [_warnings(report.warnings), _table(_fact_rows(report.facts))]
    if report.facts.symmetries:
        parts += ["<h2>Symmetries</h2>", _symmetry_table(report.facts)]
    if report.pairs:
        parts += ["<h2>Views that look alike</h2>", _pairs(report)]
    if report.trial is not None:
        parts += [
            "<h2>What to expect</h2>",
            _expectation(report),
            _confusions(report.trial.outcomes, report.registrar),
        ]
    return _PAGE.format(title=html.escape(title), body="\n".join(parts))


def _in_words(expected: Expected) -> str:
    low, high = expected.right_interval
    right = f"right in {expected.right:.2f} ({low:.2f} to {high:.2f})"
    surely = f"reliable in {expected.reliable:.2f}, median {expected.median_deg:.1f} degrees"
    return f"{right}, {surely} (of {expected.n} generated photographs)"


def _fact_rows(facts: MeshFacts) -> list[tuple[str, str]]:
    unit = facts.unit or "units"
    sides = " x ".join(f"{side:.4g}" for side in facts.extents)
    closed = "closed" if facts.is_watertight else "open: edges without a second face"
    colours = (
        "vary: its print is used"
        if facts.is_coloured
        else "none, or one plain colour: only its shape is used"
    )
    return [
        ("size", f"{sides} {unit}"),
        ("faces", f"{facts.faces:,} in {facts.parts:,} part{'s' * (facts.parts > 1)}, {closed}"),
        ("colours", colours),
        ("thin parts", f"{100 * facts.thin:.0f} % of the surface, thinner than 1 % of the size"),
        ("symmetries", _symmetries_in_words(facts)),
    ]


def _symmetries_in_words(facts: MeshFacts) -> str:
    if not facts.symmetries:
        return "none"
    if min(symmetry.angle for symmetry in facts.symmetries) < CONTINUOUS_TURN:
        return "any turn about an axis leaves the shape; steps of 10 degrees stand for them"
    return f"{len(facts.symmetries) + 1} orientations have the same shape"


def _table(rows: Sequence[tuple[Any, ...]]) -> str:
    cells = ("".join(f"<td>{html.escape(str(cell))}</td>" for cell in row) for row in rows)
    return "<table>" + "".join(f"<tr>{row}</tr>" for row in cells) + "</table>"


def _warnings(warnings: Sequence[str]) -> str:
    return "\n".join(f'<p class="warning">{html.escape(text)}</p>' for text in warnings)


def _symmetry_table(facts: MeshFacts) -> str:
    groups = defaultdict[tuple[int, bool], list[float]](list)
    for symmetry in facts.symmetries:
        turn = round(symmetry.angle), symmetry.has_same_colours
        groups[turn].append(symmetry.deviation_percent)
    rows = [("turn", "axes and directions", "surface moves by, % of the diameter", "colours")]
    rows += [
        (
            f"{angle}°",
            str(len(deviations)),
            f"{max(deviations):.2f}",
            "the same" if is_same else "differ",
        )
        for (angle, is_same), deviations in sorted(groups.items(), reverse=True)
    ]
    return _table(rows)


def _pairs(report: Inspection) -> str:
    count = (
        f"From {len(report.alike)} of {len(report.pairs)} directions another side looks alike: "
        "their edges differ by"
    )
    told = f" The print tells {report.told_by_print} of them apart."
    lines = [
        f"<p>{count} no more than those of one pose and the same pose, turned by 3 degrees."
        f"{told if report.facts.is_coloured and report.alike else ''}</p>"
    ]
    if report.registrar is not None:
        shown = report.pairs[: MOST_PAIRS if report.alike else FEW_PAIRS]
        lines += [_pair_figure(report.registrar, pair) for pair in shown]
    return "\n".join(lines)


@torch.no_grad()
def _pair_figure(registrar: Registrar, pair: LookAlike) -> str:
    distance = registrar.bank.distances.median().cpu().expand(2)
    pictures = registrar.describer.shaded(torch.stack([pair.rotation, pair.rival]), distance)
    images = "".join(_image(to_uint8(picture[-3:])) for picture in pictures)  # grey, or in colours
    verdict = "alike" if pair.is_alike else "different"
    told = f"its print and {pair.hint}" if pair.print_tells else pair.hint
    help = f"; {told} would tell" if pair.is_alike else ""
    caption = (
        f"{pair.angle:.0f}° apart: {verdict} in shape (similarity {pair.similarity:.2f}, resolved "
        f"{pair.resolved:.2f}){help}"
    )
    return f"<figure>{images}<figcaption>{caption}</figcaption></figure>"


def _image(picture: Bytes) -> str:
    return f'<img alt="" src="{embedded(jpeg(picture, 85))}">'


def _expectation(report: Inspection) -> str:
    assert report.trial is not None
    by_elevation = report.trial.by(lambda outcome: outcome.elevation, ELEVATIONS)
    by_pixels = report.trial.by(lambda outcome: outcome.photograph.pixels_across, PIXELS_ACROSS)
    camera = "known" if report.with_camera else "unknown"
    header = ("photographs", "N", "right", "within 5°", "reliable", "reliable, wrong", "median")
    rows = [header, _row(f"all, camera {camera}", report.trial.expected)]
    for ranges, name in ((by_elevation, "elevation {}°"), (by_pixels, "{} px across")):
        rows += [_row(name.format(interval), expected) for interval, expected in ranges.items()]
    for name, (before, after) in report.trial.compared.items():
        compared_with = _row(f"the first {before.n} of all", before)
        if compared_with not in rows:
            rows.append(compared_with)
        rows.append(_row(name, after))
    surroundings = "other objects around it" if report.clutter else "no clutter, nothing in front"
    note = (
        f"Right: within 30 degrees. Generated photographs ({surroundings}) are simpler than real "
        f"ones."
    )
    return f"{_table(rows)}<p>{note}</p>"


def _row(name: str, expected: Expected) -> tuple[str, ...]:
    shares = (expected.right, expected.within_5_deg, expected.reliable, expected.reliable_and_wrong)
    return (
        name,
        str(expected.n),
        *(f"{share:.2f}" for share in shares),
        f"{expected.median_deg:.1f}°",
    )


def _confusions(outcomes: Sequence[Outcome], registrar: Registrar | None) -> str:
    wrong = [outcome for outcome in outcomes if not outcome.is_right and outcome.result is not None]
    if registrar is None or not wrong:
        return ""
    figures = [_confusion_figure(outcome, registrar) for outcome in wrong[:MOST_CONFUSIONS]]
    return "<h2>Typical confusions</h2>" + "\n".join(figures)


def _confusion_figure(outcome: Outcome, registrar: Registrar) -> str:
    assert outcome.result is not None
    image = outcome.photograph.image
    drawn = Drawn(registrar.describer, outcome.result.projection)
    picture = draw_close_up(image, outcome.photograph.box.tolist(), PICTURE_SIDE, [drawn])
    confidence = outcome.result.confidence
    said = "" if confidence is None else f", confidence {two_decimals(confidence)}"
    return (
        f"<figure>{_image(picture)}<figcaption>{outcome.error_deg:.0f}° "
        f"off{said}</figcaption></figure>"
    )
