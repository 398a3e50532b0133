"""Numbers that several modules share. Those that the compiled core needs, too, are its own: `armctl._core` has them."""

DEFAULT_BANDWIDTH = 30.0  # rad/s, of controllers that compensate the inertia
# rad/s. Springs of tip and posture together then have a delay margin of 2.5 control periods at 4 ms.
IMPEDANCE_BANDWIDTH = 40.0
MIN_DELAY_MARGIN_S = 5e-3  # of default gains
MAX_PEAK_SENSITIVITY = 1.7  # a usual bound of Ms (Astrom and Hagglund, Advanced PID Control, 2006, 4.6)
SETTLE_TIMEOUT_S = 1.0  # for an arm or a gripper to come to rest
MIN_DAMPING_RATIO = 0.1  # of a closed loop; below it, a vibration takes more than three periods to fall to a tenth
AT_REST_SPEED = 1e-3  # rad/s (m/s): every joint below it counts as at rest
RESTING_S = 0.5  # a joint that moves by less than that speed allows in this time rests, however its sensors make it tremble
DEFAULT_GRIP_FORCE = 10.0  # N
MIN_JOINTS_FOR_POSES = 6  # to a tip: with fewer, most places leave no choice of the orientation
CONFIDENCE = 0.95  # of intervals
FINDING_ERRORS = 3.0  # standard errors, from which a difference is a finding
TIMESTEPS_S = (1e-6, 0.1)  # of a model or a plant
MAX_FILE_VALUE = 1e9  # in SI units: a larger number in a file is damaged

PICTURE_ENDINGS = (".png", ".svg", ".pdf")
FILM_ENDINGS = (".mp4", ".gif")
