"""Typer application to which the commands are added."""

import gc

import typer

# Python's search for garbage every 700 objects takes a tenth of the time of the imports, and of a fit
gc.set_threshold(100_000)

app = typer.Typer(
    name="fitact",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="""
Estimate the circuit of a finger on an electrovibration display, and the electrostatic force, from recorded voltages.

Start with a CSV file whose header reads `time_s,V_V,I_A` (time in s, drive in V, loop current in A) or
`time_s,V_V,Vsc_V` (skin voltage in V). Describe the panel, the finger and the drive in a scene file:

    fitact scene > scene.toml
    fitact run finger.csv --scene scene.toml --out results

The first command writes a template to edit. The second fits the circuit, samples the posterior and writes
`results/report.html`, to be opened in a browser. Without a scene, fitact assumes the device of the reference paper.
For any other oscilloscope file, start with `fitact inspect FILE`.
""",
    epilog="Exit status: 0, success; 1, results written but unreliable (see `warnings` in the "
    "results); 2, invalid input; 3, internal error; 130, interrupted. `fitact explain NAME` says what to try first.",
)
