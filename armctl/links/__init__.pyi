from .dry_run import Rehearsal as Rehearsal
from .hand import Hand as Hand
from .link import Link as Link
from .link import Seen as Seen
from .plant_link import PlantLink as PlantLink
