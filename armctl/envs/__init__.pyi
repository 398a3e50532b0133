from .arm_env import ArmEnv as ArmEnv
from .demonstrations import DemonstrationsResult as DemonstrationsResult
from .demonstrations import save_demonstrations as save_demonstrations
from .experts import ExpertPolicy as ExpertPolicy
from .vector_env import ArmVectorEnv as ArmVectorEnv
