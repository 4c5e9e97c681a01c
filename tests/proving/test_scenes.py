"""Scenes: drawn the same again, each brings about what its name says, and the package plays them well."""

import pytest

from proving.episode import Episode
from proving.scenes import NO_REST, SCENES, SCENES_FROM, WRONG_MOTIONS, named, scene
from proving.soak import drawn_by

NUMBERS = {name: SCENES_FROM + k for k, name in enumerate(SCENES)}


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_is_the_same_for_the_same_numbers_and_another_in_its_next_turn(name: str) -> None:
    on, story = drawn_by(1, NUMBERS[name])
    again, later = scene(1, NUMBERS[name], on.arm), drawn_by(1, NUMBERS[name] + len(SCENES))[1]
    assert story == again != later
    assert all(0.0 <= line.at_s <= story.duration_s for line in story.lines)
    assert named(NUMBERS[name] + len(SCENES)) == name


def test_an_episode_is_no_scene() -> None:
    assert (named(0), named(SCENES_FROM - 1)) == ("", "")


def test_two_scenes_have_an_arm_of_their_own() -> None:
    assert not drawn_by(1, NUMBERS[NO_REST])[0].arm.rest_on_strain
    assert all(drawn_by(1, NUMBERS[WRONG_MOTIONS] + k * len(SCENES))[0].arm.floor_m >= -0.1 for k in range(4))


@pytest.mark.parametrize(
    ("name", "happens"),
    [
        ("two servos are silent at once", "SERVO_SILENT"),
        ("heat, and a stop on the way to rest", "REST_AHEAD"),
        ("a limp arm gets torque from elsewhere", "NOT_LIMP"),
        ("a joint is held, and the arm strains against it", "OVERLOAD"),
        ("a joint is held, and the arm leans on it", "CONTACT"),
        ("a joint is blocked on its way", "BLOCKED"),
        ("one goal from elsewhere", "OTHER_WRITER"),
        ("runs that no host has looked at", "refused or ended: LIMIT"),
        (WRONG_MOTIONS, "refused by the host"),
        ("a tick comes late while the arm moves", "LATE"),
    ],
)
def test_a_scene_brings_about_what_it_is_for_and_the_arm_does_nothing_wrong(name: str, happens: str) -> None:
    on, story = drawn_by(1, NUMBERS[name])
    outcome = Episode(story, on).play()
    assert outcome.rows[happens]
    assert outcome.violations == []
