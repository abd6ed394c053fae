"""Private functions that commands call; lazy imports keep `fitact --help` fast."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(
    "fitact",
    submodules={"result_text", "summary"},
    submod_attrs={
        "app.server": ["serve"],
        "app.warm_commands": ["WarmCommands"],
        "data.simulate": ["simulate"],
        "data.kramers_kronig": ["check_kramers_kronig"],
        "design.drive": ["require_designable"],
        "fitting.profile": ["table"],
        "inspection.preview": ["preview"],
        "model_selection.fit_planned": ["fit_planned", "plan_for_record"],
        "paper": ["reproduce"],
        "populations.covariates": ["read_covariates"],
        "populations.fit_population": ["delete_chains"],
        "populations.record_files": ["RecordFiles"],
        "readers.read": ["read_any", "write_csv"],
        "readers.spectrum": ["is_spectrum"],
        "readers.study": ["is_study"],
        "scene.prior_predictive": ["prior_predictive"],
    },
)
