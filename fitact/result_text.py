"""Results of one finger in words: tables of estimates and budgets, verdict, and next step, from fit.json's content."""

import math
import shlex
import textwrap
from collections.abc import Iterable, Sequence
from typing import Any

from fitact.summary import (
    TRUSTED_RESULTS,
    UNSTATED_GAINS,
    UNSTATED_STRAY,
    Summary,
    combine,
    describe_quantity,
    format_estimate,
    format_interval,
    format_range,
    is_default,
    is_trusted,
)
from fitact.tables import align_table, join_lines
from fitact.units import DERIVED, GEOMETRY, PARAMETERS, format_engineering, format_percent, quantity_unit

FORCE_LAWS = {  # by [force] model
    "paper": "from Vsc with eq. (22) of the reference paper",
    "gap": "from the voltage across the interface gap, eps0 A Vgap^2 / (2 d^2)",
}
Rows = list[tuple[str, ...]]


def estimate_table(content: dict[str, Any]) -> Rows:
    """Return rows of the main results, the first of them titles.

    `content` is that of fit.json or summary.json. Cells: name, estimate with its combined standard uncertainty, 90 %
    interval, what most of the uncertainty comes from, and what the quantity rests on.
    """
    rows: Rows = [("", "estimate ± 1 sd", "90 % interval", "uncertainty from")]
    summaries = content["parameters"] | content["derived"]
    names = [name for name in content["parameters"] if name in PARAMETERS]
    remarks = {"force_mean": "computed, not measured", "times_threshold": "times the threshold of detection"}
    for name in (*names, "force_mean", *(("times_threshold",) if "times_threshold" in summaries else ())):
        s = summaries[name]
        remark = remarks.get(name, "" if name in ("Rsc", "Csc", "Ci") else describe_quantity(name))
        cells = format_estimate(s), format_interval(s), describe_sources(s)
        rows.append((name, *(cells if _has_uncertainty(s) else (_about(s), "", _missing(content))), remark))
    return rows


def _has_uncertainty(summary: Summary) -> bool:
    return "u" in summary or "combined" in summary


def _about(summary: Summary) -> str:
    """Return a value that rests on a default or on an instrument that nobody stated: "about 250 mN"."""
    rounded = float(f"{summary['q50']:.2g}")  # first, so that 999.6 uN becomes 1 mN
    return f"about {format_engineering(rounded, str(summary['unit']))}"


def _missing(content: dict[str, Any]) -> str:
    """Return what makes the uncertainty of the friction unknown."""
    friction = [a for a in content["force_basis"]["assumptions"] if a["affects"] == "friction"]
    names = [f"default {a['symbol']}" for a in friction if a["origin"] == "default"]
    return ", ".join(names) or "unstated sensor"


def describe_sources(summary: Summary, enough: float = 0.8) -> str:
    """Return what most of the variance comes from, `enough` of it if two sources are: "prior of Ci, unstated gains"."""
    named: list[str] = []
    total = 0.0
    for source, fraction in combine(summary).get("sources", {}).items():
        if total < enough and len(named) < 2 and fraction > 0.05:
            named.append(source)
            total += fraction
    return ", ".join(named)


def quantity_table(content: dict[str, Any]) -> Rows:
    """Return rows of all quantities for people, the first of them titles; a row of one cell is a heading.

    `content` is that of fit.json or summary.json. Cells: name, estimate with its combined standard uncertainty, 90 %
    interval, relative standard uncertainty, the part of it that is noise, what most of it comes from, description.
    """
    summaries = content["parameters"] | content["derived"]
    headings = "circuit", "geometry and friction", "computed, not measured", "measurement"
    groups: dict[str, Rows] = {heading: [] for heading in headings}
    for name, s in summaries.items():
        group = "computed, not measured" if name in DERIVED else "measurement"
        group = "geometry and friction" if name in GEOMETRY else group
        if name in PARAMETERS or name in ("g", "b"):
            group = "circuit"
        groups[group].append(_quantity_row(name, s, content))
    for name, s in content.get("nuisances", {}).items():
        value = format_engineering(s["value"], s["unit"], 3)
        groups["measurement"].append((name, value, "", "", "", "", describe_quantity(name)))
    rows: Rows = [("", "estimate ± 1 sd", "90 % interval", "u", "noise alone", "uncertainty from")]
    for heading, group_rows in groups.items():
        rows += [(heading,), *group_rows] if group_rows else []
    return rows


def _quantity_row(name: str, summary: Summary, content: dict[str, Any]) -> tuple[str, ...]:
    remark = "" if name in ("Rsc", "Csc", "Ci") else describe_quantity(name)
    if not _has_uncertainty(summary):
        return name, _about(summary), "", "", "", _missing(content), remark
    entry = content.get("budget", {}).get(name)
    noise = math.hypot(*(each["u"] for each in entry["components"] if each["type"] == "A")) if entry else math.nan
    u = float(combine(summary).get("u", math.inf))
    figures = (format_percent(x) if math.isfinite(x) else "" for x in (u, noise))
    return name, format_estimate(summary), format_interval(summary), *figures, describe_sources(summary), remark


def force_sentences(basis: dict[str, Any]) -> list[str]:
    """Return what a force rests on, in sentences; `basis` is `force_basis` of fit.json or summary.json."""
    law = f"Force: computed {FORCE_LAWS[basis['law']]}"
    if basis["tested_by_data"]:
        sentences = [f"{law}, which the measured friction tests."]
    else:
        sentences = [f"{law}; it was not measured, and these data do not test that law."]
    if basis["assumptions"]:
        values = ", ".join(f"{a['symbol']} = {a['text']} ({a['origin']})" for a in basis["assumptions"])
        included = [a["symbol"] for a in basis["assumptions"] if a.get("has_distribution")]
        stated = f", of the stated distributions ({', '.join(included)})" if included else ""
        sentences.append(
            f"Force and friction rest on {values}; default means that nobody stated it. Their uncertainty includes that"
            f" of the prior{stated} and of Tsc, but of no other of these values."
        )
    if other := basis["other_law"]:
        force = _about(other["force_mean"])
        sentences.append(f"Mean force by the other law ({FORCE_LAWS[other['law']]}): {force}, for the same data.")
    return sentences


def _compare_with_friction(content: dict[str, Any]) -> list[str]:
    """Return what a measured friction says about the computed force, in a sentence."""
    scale = content["parameters"].get("force_scale")
    if scale is None:
        return []
    ratio, u = float(scale["q50"]), float(combine(scale).get("u", math.inf))
    if not u < 1.0:
        return ["The measured friction does not determine how far the computed force is right (force_scale)."]
    sentence = f"The force in the measured friction is {format_estimate(scale)} times the computed one (force_scale"
    sentence += f", combined u {format_percent(u)} of its logarithm): "
    if abs(math.log(ratio)) <= 2.0 * u:
        sentence += "they agree."
    else:
        sentence += "they differ, so the law, the contact area, a thickness or the normal force is wrong."
    sentence += " This rests on mu, which follows from the mean friction and the normal force."
    if content["identifiability"]["verdict"] != "identified":
        sentence += " The electrical channels do not determine the contact area, whose error force_scale contains."
    return [sentence]


def result_sentences(content: dict[str, Any]) -> list[str]:
    """Return what the force rests on, and how far it is felt if the scene has a table of thresholds."""
    felt = content.get("sensation")
    friction = _compare_with_friction(content)
    return [*force_sentences(content["force_basis"]), *friction, *([felt["sentence"]] if felt else [])]


def budget_sentence(content: dict[str, Any]) -> str:
    """Return what the uncertainties include; `content` is that of fit.json or summary.json."""
    entries = content.get("budget") or {}
    if not entries:
        return ""
    head = "Uncertainties combine noise, priors, instruments, geometry and structure of the residuals (fitact budget)."
    missing = entries["g"]["not_stated"]
    if not missing:
        return head
    equipment = ", ".join(f"{each['source']} ({each['typical']})" for each in missing)
    return f"{head} Not stated, so usual errors are included: {equipment}. State yours under [instrument]."


def budget_table(name: str, content: dict[str, Any], min_share: float = 0.001) -> Rows:
    """Return rows of the uncertainty budget of a quantity, titles first, largest component first.

    `content` is that of fit.json or summary.json. Usual errors of what nobody stated are components; sources below
    `min_share` of the variance are one row. The last row has the combined uncertainty.
    """
    combined, components = combine((content["parameters"] | content["derived"])[name]), list_components(name, content)
    rows: Rows = [(name, "type", "u(x)", "sensitivity", "component", "share")]
    small = [each for each in components if each["share"] < min_share]
    for each in components:
        if each["share"] >= min_share:
            sensitivity = "" if each["type"] == "A" else f"{each['sensitivity']:+.2g}"
            cells = (each["type"], format_percent(each["input_u"]), sensitivity, format_percent(each["u"]))
            rows.append((each["source"], *cells, format_percent(each["share"]), each["reduce_by"]))
    if small:
        u, share = math.hypot(*(each["u"] for each in small)), sum(each["share"] for each in small)
        rows.append((f"{len(small)} smaller sources", "", "", "", format_percent(u), format_percent(share), ""))
    low, high = combined["q025"], combined["q975"]
    interval = format_range(low, high, 0.25 * (high - low), quantity_unit(name))
    rows.append(("combined", "", "", "", format_percent(combined["u"]), "", f"95 % interval {interval}"))
    return rows


def list_components(name: str, content: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the components of the combined uncertainty of a quantity, largest first, each with its share.

    `content` is that of fit.json or summary.json. Usual errors of what nobody stated are among them.
    """
    entry, combined = content["budget"][name], combine((content["parameters"] | content["derived"])[name])
    components = [*entry["components"]]
    for each in entry["not_stated"]:
        source = f"{each['source']}, not stated (usual: {each['typical']})"
        sensitivity = each["u"] / each["input_u"] if each["input_u"] else 0.0
        known = {"type": "B", "sensitivity": sensitivity, "reduce_by": "state and calibrate it"}
        components.append(each | known | {"source": source})
    variance = float(combined["u"]) ** 2
    shares = ({"share": each["u"] ** 2 / variance if variance else 0.0} for each in components)
    ranked = (each | share for each, share in zip(components, shares, strict=True))
    return sorted(ranked, key=lambda each: -each["share"])


def blind_table(content: dict[str, Any], names: Sequence[str] = ("g", "b", "force_mean"), count: int = 8) -> Rows:
    """Return rows of the causes that may shift the quantities `names` most without a trace in the residuals.

    Titles come first. A cause of a plausible size is meant.
    """
    titles = ("what the residuals would not show", "visible", *names)
    causes = [each for each in content.get("blind_table", []) if all(name in each["shift"] for name in names)]
    causes.sort(key=lambda each: -max(each["shift"][name] for name in names))
    shown = [
        (each["name"], format_percent(each["visible"]), *(format_percent(each["shift"][name]) for name in names))
        for each in causes[:count]
    ]
    return [titles, *shown] if shown else []


def budget_text(content: dict[str, Any], names: Sequence[str] = ()) -> str:
    """Return the uncertainty budgets of the quantities `names`, or of all, for people."""
    tables = [budget_table(name, content) for name in names or content["budget"]]
    tables += [rows] if (rows := blind_table(content)) else []
    return "\n\n".join([budget_sentence(content), *("\n".join(align_table(table)) for table in tables)])


def next_measurements(content: dict[str, Any]) -> Rows:
    """Return rows of changes that would narrow the mean force, best first, titles and the present state before them.

    Cells: change, expected relative standard uncertainty of the mean force, its part from the circuit, what it needs.
    """
    combined = combine(content["derived"]["force_mean"])
    u, identifiability = float(combined["u"]), content["identifiability"]
    if not math.isfinite(u):
        return []
    circuit = float(identifiability["force_sd"])
    changes = [(each["text"], each["u"], each["force_sd"], each["needs"]) for each in identifiability["remedies"]]
    for source, fraction in combined["sources"].items():
        part = u * math.sqrt(fraction)
        if is_default(source) and part > 0.01 * u:
            what, needs = _describe_default(source)
            changes.append((what, math.sqrt(u**2 - 0.75 * part**2), circuit, needs))
    changes.sort(key=lambda change: (float(f"{change[1]:.2g}"), change[2]))
    rows: Rows = [("change", "u of force_mean", "of the circuit", "needs")]
    rows.append(("none", format_percent(u), format_percent(circuit), ""))
    return [*rows, *((text, format_percent(a), format_percent(b), needs) for text, a, b, needs in changes)]


def _describe_default(source: str) -> tuple[str, str]:
    """Return the change that halves the uncertainty of a default, and what it needs."""
    if source == UNSTATED_GAINS:
        return "half the errors of gains", "state and calibrate your instruments ([instrument])"
    if source == UNSTATED_STRAY:
        return (
            "half the uncertainty of the stray capacitance",
            "record once without a finger, or I in the ground lead",
        )
    name = source.removeprefix("default ").removeprefix("spread of ")
    if name == "skin thickness":
        return f"half the uncertainty of the {name}", "measure it, e.g. by optical coherence tomography"
    return f"half the uncertainty of {name}", f"measure {name}"


def next_step(content: dict[str, Any]) -> str:
    """Return the one thing to do next, a sentence."""
    names = result_names(content)
    if names and not is_trusted(content):
        return f"Next: {command_to_explain(names[0])} says what to try first."
    parameters = content["parameters"]
    names = [name for name in content["identifiability"]["blind_direction"] if name in parameters]
    if remedies := content["identifiability"]["remedies"]:
        now = max(abs(parameters[name]["sd"] / parameters[name]["q50"]) for name in names)
        then = max(remedies[0]["sd"][name] for name in names)
        present = format_percent(now) if now < 1.0 else "undetermined"
        what = f"{', '.join(names)} to {format_percent(then)} (now {present}), gain errors apart"
        return f"Next: {remedies[0]['text']} would give {what}."
    if advice := content["identifiability"]["advice"]:
        return f"Next: {advice}"
    for name in (*names, "force_mean"):
        combined = combine((parameters | content["derived"])[name])
        source = next(iter(combined.get("sources", {})), "")
        if is_default(source):
            u = format_percent(combined["u"])
            return f"Next: {_describe_default(source)[1]}; the ± {u} of {name} is mostly {source}."
    if components := content["budget"]["force_mean"]["components"]:
        largest = max(components, key=lambda each: each["u"])
        return f"Next: the largest source of u of force_mean is {largest['source']}; {largest['reduce_by']}."
    return ""


def verdict_sentence(content: dict[str, Any]) -> str:
    """Return whether the result is reliable and what the data determine, in a sentence."""
    id, fit = content["identifiability"], content["fit"]
    if not is_trusted(content):
        reason = "sampling did not converge" if fit["result"] in TRUSTED_RESULTS else fit["result"]
        return f"Unreliable ({reason}): do not use these numbers."
    if id["verdict"] == "identified":
        return f"Identified: the data determine {_list(list(id['blind_direction']))}."
    channels = " and ".join(id["channels"])
    if id["structural"]:
        alone = " alone" if len(id["channels"]) == 1 else ""
        reason = f"{channels}{alone} cannot determine {id['blind_name'].partition(', which')[0]}"
    else:
        reason = f"this record does not constrain {id['blind_name'].partition(', which')[0]}"
    setting = "the prior of Ci sets it" if "Ci" in id["blind_direction"] else "the prior sets it"
    prior = setting if id["verdict"] == "prior-limited" else "neither does a prior"
    return f"{id['verdict'].capitalize()}: {reason}; {prior}."


def describe_result(content: dict[str, Any], description: str = "", width: int = 110, warning_lines: int = 2) -> str:
    """Return in about a dozen lines what to know of a result; `content` is that of fit.json or summary.json.

    `description` is that of the scene. Lines have at most `width` columns, and each warning `warning_lines` lines.
    """
    lines = align_table(estimate_table(content), gap=2, words=1)
    for sentence in (verdict_sentence(content), next_step(content)):
        lines += _wrap(sentence, width)
    warnings = dict.fromkeys(content["warnings"])
    for text in filter(None, (f"note: {description}" if description else "", *(f"warning: {w}" for w in warnings))):
        wrapped = _wrap(text, width)
        if len(wrapped) > warning_lines:
            wrapped = textwrap.wrap(
                text, width, subsequent_indent="  ", max_lines=warning_lines, placeholder=" ... (--verbose)"
            )
        lines += wrapped
    return "\n".join(lines)


def _wrap(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, subsequent_indent="  ", break_on_hyphens=False)


def describe_fully(content: dict[str, Any], details: Iterable[str] = ()) -> str:
    """Return all that a result says, for people; `content` is that of fit.json or summary.json."""
    sentences = filter(None, (verdict_sentence(content), budget_sentence(content), *result_sentences(content)))
    rows = [*align_table(quantity_table(content), words=1), *sentences, *details]
    if len(measurements := next_measurements(content)) > 2:
        rows += align_table(measurements, words=1)
    return join_lines([*rows, *advice_line(content)], content["warnings"], content["notes"])


def describe_summary(content: dict[str, Any], *, verbose: bool = False) -> str:
    """Return the content of summary.json for people: the main results, or all."""
    if not verbose:
        return describe_result(content, content["scene"].get("description", ""))
    return describe_fully(content, [content[section]["sentence"] for section in ("convergence", "identifiability")])


def _list(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def result_names(content: dict[str, Any]) -> list[str]:
    """Return the names of results that need advice (see `fitact.what_now`); `content` is fit.json or summary.json."""
    names = [] if content["fit"]["result"] == "successful" else [content["fit"]["result"]]
    convergence = content.get("convergence", {"converged": True})
    if not convergence["converged"]:
        names += [{"psis": "k-hat", "laplace": "laplace"}.get(convergence["level"], "not converged")]
    verdict = content["identifiability"]["verdict"]
    return names + ([] if verdict == "identified" else [verdict])


def command_to_explain(name: str) -> str:
    """Return the command that explains the name of a result."""
    return f"fitact explain {shlex.quote(name)}"


def advice_line(content: dict[str, Any]) -> list[str]:
    """Return the line that names the advice for a result; none for an identified, reliable one."""
    commands = [command_to_explain(name) for name in result_names(content)]
    return [f"What to do now: {', '.join(commands)}"] if commands else []
