from .campaign import write_campaign
from .folder import write_folder
from .frame import Provenance
from .page import read_results, write_report
from .population import read_population, write_population, write_population_page
from .prior import write_prior
from .record import write_record, write_spectra
from .reproduction import write_reproduction
from .track import write_track

__all__ = [
    "Provenance",
    "read_population",
    "read_results",
    "write_campaign",
    "write_folder",
    "write_population",
    "write_population_page",
    "write_prior",
    "write_record",
    "write_report",
    "write_reproduction",
    "write_spectra",
    "write_track",
]
