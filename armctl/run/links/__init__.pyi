from .dry_run import Rehearsal as Rehearsal
from .franka import Franka as Franka
from .hand import Hand as Hand
from .link import Link as Link
from .link import Seen as Seen
from .link_check import LinkCheck as LinkCheck
from .plant_link import PlantLink as PlantLink
from .so101 import SO101 as SO101
