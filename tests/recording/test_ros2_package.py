"""The ROS 2 package `armctl_msgs`: what ROS makes of it is what stands in the logs."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armctl import __version__
from armctl.recording.channels import TOPICS
from armctl.recording.schemas import MESSAGES, full_name, parse_schema, schema_text

PACKAGE = Path(__file__).parents[2] / "armctl" / "docs" / "armctl_msgs"
NAMES = [f"armctl_msgs/{path.stem}" for path in sorted((PACKAGE / "msg").glob("*.msg"))]


def test_every_message_of_armctl_in_a_log_is_in_the_package() -> None:
    ours = {topic.type for topic in TOPICS.values() if topic.type.startswith("armctl_msgs/")}
    assert len(ours) >= 4
    assert {full_name(name) for name in NAMES} >= {full_name(name.replace("/msg/", "/")) for name in ours}


@pytest.mark.parametrize("name", NAMES)
def test_rosbags_gives_files_and_schemas_of_logs_the_same_hash(name: str) -> None:
    ros = get_typestore(Stores.ROS2_JAZZY)
    for path in sorted((PACKAGE / "msg").glob("*.msg")):
        ros.register(get_types_from_msg(path.read_text(encoding="utf-8"), f"armctl_msgs/msg/{path.stem}"))
    log = get_typestore(Stores.EMPTY)
    for part, body in parse_schema(name, schema_text(name)).items():
        log.register(get_types_from_msg(body, full_name(part)))
    assert ros.hash_rihs01(full_name(name)) == log.hash_rihs01(full_name(name))


def test_the_package_says_what_it_needs_and_of_which_armctl_it_is() -> None:
    about = ET.parse(PACKAGE / "package.xml").getroot()
    needed = {name.partition("/")[0] for own in NAMES for name in re.findall(r"^\w+/\w+", MESSAGES[own], re.MULTILINE)}
    assert {one.text for one in about.findall("depend")} == needed - {"armctl_msgs"}
    assert about.findtext("version") == __version__
    told = (PACKAGE / "CMakeLists.txt").read_text(encoding="utf-8")
    assert set(re.findall(r"find_package\((\w+) REQUIRED\)", told)) >= needed - {"armctl_msgs"}
    assert "msg/*.msg" in told
