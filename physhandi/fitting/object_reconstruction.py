"""Stage 2: find the spring-mass object whose simulated motion explains what was seen."""

from collections.abc import Sequence as Many

from physhandi.fitting.candidates import Judge
from physhandi.fitting.object_config import ObjectFitConfig
from physhandi.fitting.object_problem import ObjectProblem
from physhandi.fitting.reach import check_problem
from physhandi.fitting.search import SearchResult, search_parameters
from physhandi.progress import Progress
from physhandi.simulation.model import SimulationParameters


def search_object(
    problems: Many[ObjectProblem],
    start: SimulationParameters,
    config: ObjectFitConfig,
    progress: Progress,
    *,
    device: str = "cpu",
) -> SearchResult:
    """Find the global parameters, topology included, that explain all sequences best.

    Args:
        problems: One for each sequence; all must have the same object nodes at rest.
        start: Parameters to start from.
        config: What stage 2 does.
        progress: Told once a generation.
        device: Warp device.

    Returns:
        The best global parameters.

    Raises:
        FitError: If no spring can form, or every candidate diverges.
    """
    for problem in problems:
        check_problem(problem, start, config.search)
    judge = Judge(problems, config, progress, device=device)
    return search_parameters(judge, start, config.search, progress)
