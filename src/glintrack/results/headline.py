"""First screen of the report: one number and three sentences, all per 100 moving vehicles."""

import math
from typing import NamedTuple

from glintrack.results import verdict
from glintrack.results.losses import LOSSES, find_remedy, largest_loss
from glintrack.results.read import Result

_MEANINGS = {"pan": "pan (intensity)", "dolp": "DoLP (degree of polarization)", "all": "all elements"}
_NO_LOSS = "Nowhere: every stage keeps all vehicles."
_NO_REMEDY = "No recorded study applies to this design. Compare two designs with `glintrack study`."
_NO_BUDGET = "Not known, because the loss budget was not measured."
_MEASURE = (
    "Measure the loss budget: `glintrack bound case.toml`, in the folder of this result, prints it. A run "
    "shows it here if `bound.every` is above 0 and below the number of frames."
)


class Headline(NamedTuple):
    """One number of 100 moving vehicles and three sentences; code is between backticks."""

    number: str
    words: str  # what the number counts
    tracked: str
    lost: str
    advice: str
    denominator: str  # what 100 stands for
    warning: str  # why the run is too short to judge a design; may be empty
    stage: str  # of the largest loss; may be empty


def headline(result: Result) -> Headline | None:
    """Headline of a result; None if no vehicle was scored."""
    name, tree = verdict.select_channel(result.scores), result.tree
    if name is None or tree is None:
        return None
    attributes, where = tree[name].attrs, verdict.scored_area(tree)
    budget = verdict.stage_shares(tree).get(name, {})
    movers, false = (float(attributes.get(k, math.nan)) for k in ("vehicles_per_frame", "false_per_frame"))
    number, loss = verdict.per_hundred(result.scores[name]["completeness"]), largest_loss(budget)
    tracked = f"{verdict.describe_subject(name)} {number}"
    if movers > 0 and math.isfinite(false):
        tracked += f", with {verdict.per_hundred(false / movers)} false tracks per 100 vehicles"
    shares = [(k, float(of.get("completeness", math.nan))) for k, of in result.scores.items() if k != name]
    others = [f"{_MEANINGS.get(k, k)} alone {verdict.per_hundred(n)}" for k, n in shares if math.isfinite(n)]
    parts = [tracked, *([", ".join(others)] if others else [])]
    if loss is not None:
        remedy = find_remedy(loss.stage, result.case)
        before, after = verdict.per_hundred(loss.before), verdict.per_hundred(loss.after)
        lost = f"{LOSSES[loss.stage]}: {before} are left before this stage, {after} after it."
        advice = _NO_REMEDY if remedy is None else f"{remedy.advice}. {remedy.evidence}"
    else:
        lost, advice = (_NO_LOSS, _NO_REMEDY) if len(budget) > 1 else (_NO_BUDGET, _MEASURE)
    count = verdict.describe_frames(int(attributes.get("frames", 0))) or "all frames"
    mean = f" ({movers:.0f} move there at a time)" if movers > 0 else ""
    return Headline(
        number=number,
        words=f"of 100 moving vehicles {where} are tracked",
        tracked="".join(f"{part[:1].upper()}{part[1:]}. " for part in parts).strip(),
        lost=lost[:1].upper() + lost[1:],
        advice=advice[:1].upper() + advice[1:],
        denominator=f"All numbers of vehicles here are per 100 moving vehicles {where}{mean}, in the mean of "
        f"{count}.",
        warning=verdict.describe_undecided(tree, name).strip(),
        stage="" if loss is None else loss.stage,
    )
