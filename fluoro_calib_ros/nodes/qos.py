"""Quality of service of the topics, in one place."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

# A fluoroscope at 1000 frames a second and a reader that is busy for a tenth of one.
OBSERVATIONS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=100, reliability=ReliabilityPolicy.RELIABLE
)
# Images of a megabyte and more: few are held, a twelfth of a second of 120 Hz, and who is slower
# gets the newest ones.
IMAGES = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=10, reliability=ReliabilityPolicy.RELIABLE
)
LATCHED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
# What many have latched on a topic, as on /tf_static, comes from one player.
LATCHED_RECORDED = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


def overridable():
    """Options that let a user override history, depth and reliability of a topic by parameters."""
    return QoSOverridingOptions.with_default_policies()
