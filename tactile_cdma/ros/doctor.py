# SPDX-License-Identifier: Apache-2.0

"""Is ROS 2 sound here? A program for `tactile-cdma doctor`: a check a line, as JSON.

A process of its own, since what is broken in ROS may end the process or hang it. Nothing of ROS is
imported before it is known to be there.
"""

import importlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from importlib import metadata, util
from pathlib import Path

from ..base.named_file import CHECKOUT
from ..doctor.report import Check, Grade, ok, problem, warning

INTERFACES = (
    *("diagnostic_msgs", "geometry_msgs", "lifecycle_msgs", "sensor_msgs", "std_msgs", "std_srvs"),
    *("tf2_msgs", "visualization_msgs"),
)
"""Packages of messages that the driver needs."""
MOST_DOMAIN = 101
"""Beyond, ports of DDS fall among those that Linux hands out to anybody."""
HIGHEST_DOMAIN = 232
RANGES = ("SUBNET", "LOCALHOST", "OFF", "SYSTEM_DEFAULT")
MEETING_S = 15.0
NO_LOG_FILE = ["--ros-args", "--disable-external-lib-logs"]
"""Without a home folder ROS cannot write one, and the driver does without."""
SPEAK = "--speak"


def examination() -> Iterator[Check]:
    """Yield all that there is to say, up to what makes the rest moot."""
    if util.find_spec("rclpy") is None:
        yield warning(
            "ROS 2",
            "not found, only the command line works: source /opt/ros/<distribution>/setup.bash, "
            "or make setup in the checkout",
        )
        return
    try:
        import rclpy
    except Exception as error:  # whatever a broken installation comes up with
        yield problem("ROS 2", f"rclpy cannot be imported: {error}")
        return
    yield ok("ROS 2", f"{distribution()}, rclpy in {Path(rclpy.__file__).parent}")
    yield from messages()
    domain = list(environment())
    yield from domain
    if not any(check.verdict is Grade.PROBLEM for check in domain):
        yield from meeting()


def distribution() -> str:
    """Name of the ROS 2 distribution."""
    if name := os.environ.get("ROS_DISTRO"):
        return name
    wheels = (str(wheel.metadata["Name"] or "").split("-") for wheel in metadata.distributions())
    names = (n[1] for n in wheels if len(n) == 3 and (n[0], n[2]) == ("ros", "rclpy"))
    return f"{next(names, 'distribution unknown,')} from PyPI"


def messages() -> Iterator[Check]:
    """Check that others' messages are there; ours are built, and of these sources."""
    missing = [name for name in INTERFACES if util.find_spec(name) is None]
    if missing:
        yield problem(
            "messages", f"{', '.join(missing)} missing: rosdep install --from-paths src, or apt"
        )
    build = "colcon build, then source install/setup.bash (in the checkout: make setup)"
    try:
        for kind in ("msg", "srv"):
            importlib.import_module(f"tactile_cdma.{kind}")
    except Exception as error:  # not built, or built for another Python
        yield problem("our messages", f"not built for this Python ({error}): {build}")
        return
    stale = stale_messages(CHECKOUT, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))
    if stale:
        yield problem("our messages", f"{', '.join(stale)} changed since they were built: {build}")
    else:
        yield ok("our messages", "built")


def stale_messages(checkout: Path, prefixes: list[str]) -> list[str]:
    """Definitions in the checkout that differ from those that were built."""
    shares = (Path(prefix) / "share" / "tactile_cdma" for prefix in prefixes if prefix)
    share = next((share for share in shares if share.is_dir()), None)
    if share is None or not (checkout / "package.xml").is_file():
        return []
    sources = sorted([*checkout.glob("msg/*.msg"), *checkout.glob("srv/*.srv")])
    built = [share / path.relative_to(checkout) for path in sources]
    return [
        path.name
        for path, other in zip(sources, built, strict=True)
        if not other.is_file() or other.read_bytes() != path.read_bytes()
    ]


def environment() -> Iterator[Check]:
    """Check the settings that decide who hears whom."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if not text.isdecimal() or int(text) > HIGHEST_DOMAIN:
        yield problem("ROS_DOMAIN_ID", f"{text!r} is not a number from 0 to {HIGHEST_DOMAIN}")
    elif int(text) > MOST_DOMAIN:
        yield warning("ROS_DOMAIN_ID", f"{text}: beyond {MOST_DOMAIN} ports may be taken on Linux")
    else:
        yield ok("ROS_DOMAIN_ID", f"{text}: programs of other domains are not heard")
    if os.environ.get("ROS_LOCALHOST_ONLY", "0") not in ("", "0"):
        yield warning(
            "ROS_LOCALHOST_ONLY",
            "set, and stronger than ROS_AUTOMATIC_DISCOVERY_RANGE, which has replaced it: unset it",
        )
    reach = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "")
    if reach and reach.upper() not in RANGES:
        yield problem("ROS_AUTOMATIC_DISCOVERY_RANGE", f"{reach!r} is none of {', '.join(RANGES)}")
    elif reach.upper() == "OFF":
        yield warning("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF: programs do not find each other")
    elif reach.upper() == "LOCALHOST":
        yield ok("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST: this computer only")


def meeting() -> Iterator[Check]:
    """Tell whether two programs find each other and exchange a message."""
    import rclpy
    from std_msgs.msg import String

    topic = f"/tactile_cdma_doctor_{os.getpid()}"
    heard: list[str] = []
    try:
        rclpy.init(args=NO_LOG_FILE)
        node = rclpy.create_node("tactile_cdma_doctor", enable_rosout=False)
        node.create_subscription(String, topic, lambda message: heard.append(message.data), 10)
    except Exception as error:  # a middleware that is not installed, a domain without free ports
        yield problem("DDS", f"no node can be made: {error}")
        return
    middleware = rclpy.get_rmw_implementation_identifier()
    start = time.monotonic()
    command = [sys.executable, "-m", "tactile_cdma.ros.doctor", SPEAK, topic]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as speaker:
        try:
            while not heard and time.monotonic() - start < MEETING_S and speaker.poll() is None:
                rclpy.spin_once(node, timeout_sec=0.1)
        finally:
            speaker.kill()
    took_s = time.monotonic() - start
    node.destroy_node()
    rclpy.try_shutdown()
    if heard:
        yield ok("DDS", f"{middleware}: two programs met within {took_s:.1f} s")
    else:
        yield problem(
            "DDS",
            f"{middleware}: two programs on this computer do not find each other: does a firewall "
            "or a VPN hold back UDP on lo (sudo ip link set lo multicast on), is /dev/shm full?",
        )


def speak(topic: str) -> None:
    """Speak, as the other program, until killed or MEETING_S have passed."""
    import rclpy
    from std_msgs.msg import String

    rclpy.init(args=NO_LOG_FILE)
    node = rclpy.create_node("tactile_cdma_doctor_speaker", enable_rosout=False)
    publisher = node.create_publisher(String, topic, 10)
    end = time.monotonic() + MEETING_S
    while time.monotonic() < end:
        publisher.publish(String(data="here"))
        time.sleep(0.1)


def main() -> int:
    """Print checks."""
    if sys.argv[1:2] == [SPEAK]:
        speak(sys.argv[2])
        return 0
    for check in examination():
        print(json.dumps(asdict(check)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
