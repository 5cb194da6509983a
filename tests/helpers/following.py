"""A mapper that is given frames as the pipeline gives them: tracked from the one before."""

from sags_node.mapping.budget import Budget
from sags_node.mapping.mapped import Mapped
from sags_node.mapping.mapper import Mapper
from sags_node.mapping.motion import Drawn, SurfaceTracker
from sags_node.types import Observation


class Following:
    def __init__(self, mapper: Mapper) -> None:
        self.mapper = mapper
        self.last: Drawn | None = None

    def take(self, observation: Observation, budget: Budget, still: int = 0) -> Mapped:
        budget.start()
        tracks = None
        if self.last is not None and not still:
            tracks = SurfaceTracker().track(self.mapper.model.means, self.last, observation)
        mapped = self.mapper.update(observation, tracks, budget, still)
        if not still or self.last is None:
            self.last = Drawn(observation, mapped.view)
        return mapped
