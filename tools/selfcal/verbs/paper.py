"""Make the figures of Stepanov & Motorin (2017) anew, on one page with the words of the paper."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from selfcal.base.errors import UserError, note
from selfcal.base.options import option
from selfcal.verbs._shared import Results, Scheduler

if TYPE_CHECKING:
    from selfcal.studies.paper_figures.reproduction import Reproduction


def paper(
    output: Annotated[Path | str, option("Page to write", "-o", "--output", metavar="FILE.html", show_default=False)],
    *,
    data: Annotated[
        Path | str | None, option("Folder of the real recordings; default: beside the repository", metavar="DIR")
    ] = None,
    records: Annotated[int, option("Records per law in Figs 1 and 2", metavar="N")] = 500,
    seed: Annotated[int, option("Same seed, same page", metavar="N", min=0)] = 1,
    scheduler: Scheduler = None,
    results: Results = None,
) -> list[Reproduction]:
    """Write the page to `output`; returns its figures.

    Where the real recordings are absent, their figures and a line say so. All seeds follow from `seed`.
    """
    from selfcal.base.output import check_writable, write_text
    from selfcal.base.progress import bar
    from selfcal.batch.spread import record_seeds
    from selfcal.model.file import Model
    from selfcal.studies.paper import DATA, EXPLAINED, paper_html, with_reason
    from selfcal.studies.paper_figures import section3, section4, survey
    from selfcal.studies.paper_figures.reproduction import Reproduction
    from selfcal.verbs.diagnose import diagnose

    check_writable(output)
    seeds = record_seeds(records, seed)
    folder = DATA if data is None else Path(data)
    if data is not None and not folder.is_dir():
        raise UserError(f"--data {folder}: there is no such folder")
    areas = survey.surveys(seed)
    priors, default = Model.load(section3.PAPER), section4.two_laws(Model.load())
    rows = section3.ensemble(priors, seeds, seed, scheduler, results)
    figures = [section3.figure_1(rows), section3.figure_2(rows), *section3.figures_3_and_4(seed)]
    with bar() as progress:
        task = progress.add_task("Figs 5 to 8", total=5)
        simulated = section4.simulated(seed)
        figures += section4.figures_5_and_6(default, simulated, False, seed)
        progress.advance(task)
        real = section4.real(folder)
        progress.advance(task)
        if len(real) == len(section4.STRETCHES):
            figures += with_reason(section4.figures_5_and_6(default, real, True, seed), folder / EXPLAINED, diagnose)
        else:
            missing = sorted({name for name, _ in section4.STRETCHES if not (folder / name).exists()})
            note(
                f"REAL DATA ABSENT: {', '.join(missing)} not in {folder}: Figs 5 and 6 are of simulated records alone;"
                " name their folder with --data DIR"
            )
            figures.append(
                Reproduction(
                    "Figs 5, 6, real",
                    (),
                    "P(random walk) goes to 1 on four accelerometer records.",
                    "Not made: the real recordings are absent. The README says where they are; --data names a folder.",
                    "skipped",
                )
            )
        progress.advance(task)
        figures += section4.figures_7(default, simulated | real, seed)
        progress.advance(task)
        figures += [section4.figure_8(priors, seed), survey.figure(priors, areas)]
        progress.advance(task)
    write_text(output, paper_html(figures, records, seed))
    return figures


def show(figures: list[Reproduction], given: Mapping[str, Any]) -> None:
    """Print a line a figure."""
    from selfcal.studies.paper import show as table

    table(figures, given["output"])
