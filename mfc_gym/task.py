"""What is asked of a plant: where it starts, what it follows, and what input it has."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Task:
    """The default episode of a plant. Sets are boxes, drawn uniformly in the random scenario."""

    theta: tuple[float, ...] | None = (
        None  # the plant's uncertain parameters in the fixed scenario; None: mid of the set
    )
    initial_state: tuple[float, ...] | None = None  # None: the origin
    initial_set: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # state -> interval; left out: fixed
    model_pole: float = 2.0  # 1/s, n-fold pole of the model loop that suits the transients asked for
    process_pole: float = 4.0  # 1/s, n-fold pole of the process loop that suits the plant's input
    input_limit: float = 50.0  # abs(u) <= input_limit, unit of u
    reference: str = "sine"
    reference_parameters: Mapping[str, float] = field(default_factory=dict)  # fixed, also in the random scenario
    reference_scale: float = 1.0  # what an amplitude of 1 stands for in every family of references, unit of y
    reference_offset: float = 0.0  # the middle of every family, unit of y
    reference_rate: float = 1.0  # 1/s, what a frequency of 1 stands for
    cost_max: float = 10.0  # largest cost per second, unit of y (or its square)
    success_error: float = 0.05  # abs(y - y_d) at the end of a successful episode, unit of y
    horizon: float = 20.0  # s
    dt: float = 0.01  # s, sampling time
