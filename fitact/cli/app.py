"""The program that commands belong to."""

import typer

app = typer.Typer(
    name="fitact",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    help="""
Skin and insulator parameters, and the electrostatic force, of an electrovibration display.

Start with a CSV of your oscilloscope whose header reads `time_s,V_V,Vsc_V` (drive and skin voltage):

    fitact run finger.csv

It fits the circuit, samples the posterior and writes a report to open in a browser. Say what you know of
the panel, the finger and the drive in a scene file (TOML) and add `--scene scene.toml`. With any other file of an
oscilloscope start with `fitact inspect FILE`.

Exit code 0: an answer. 1: an answer that must not be trusted (the files say why). 2: input was refused.
""",
)
