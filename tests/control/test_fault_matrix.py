"""The fault matrix as a table: every row, its codes, and the tests that hold detection, bound and reaction.

A row without a test, a test that is not there, a code that nothing holds: each fails here. Where a test stands does not
matter, so that a module of tests can be divided.
"""

import re
from pathlib import Path

import pytest

from armctl.control import faults

TESTS = Path(__file__).resolve().parent.parent
FUNCTIONS = {
    name
    for path in TESTS.rglob("test_*.py")
    for name in re.findall(r"^(?:async )?def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
}
MATRIX = """
lost or slow reply: NO_REPLY
    test_status_read_is_waited_for_about_5_ms
    test_bad_reply_is_repeated_once_and_then_good
    test_bad_reply_twice_is_a_stale_reading_that_says_so
    test_a_motion_pauses_for_a_stale_servo_and_goes_on
bad checksum, garbage, echo, wrong id, late reply: BUS_NOISE
    test_any_bytes_for_a_reply_are_bounded_in_time_and_never_look_fresh
    test_echoing_adapter_never_looks_like_a_servo
    test_late_reply_is_drained_and_never_taken_for_the_next_servos
    test_motion_no_servo_can_make_is_noise
    test_damaged_replies_above_a_tenth_latch_and_below_do_not
two servos with one id: DUPLICATE_ID
    test_doubled_replies_hint_at_two_servos_with_one_id
    test_problems_found_at_connection_forbid_torque_until_they_are_gone
a servo silent: SERVO_SILENT
    test_a_silent_servo_latches_and_the_others_hold
    test_missing_servo_is_named_with_its_joint
    test_silent_servo_is_named_and_torque_refused
whole bus silent: BUS_DEAD
    test_a_silent_bus_is_one_fault_also_where_its_servos_fell_silent_one_by_one
    test_silent_bus_is_one_problem
USB unplugged, replugged: PORT_GONE PORT_BACK
    test_unplugging_latches_at_once_and_clears_only_after_replugging
    test_unplugging_latches_and_a_replug_leads_back_to_holding_by_clear
    test_unplugged_adapter_latches_and_a_replug_leads_back_to_running
another program on the port: OTHER_WRITER
    test_second_open_is_refused_and_names_the_holder
    test_port_of_another_process_names_it
    test_what_a_servo_reports_against_us_latches_in_one_tick
    test_settings_that_change_by_themselves_latch_in_one_tick
adapter latency 16 ms: SLOW_ADAPTER
    test_low_latency_is_read_back_from_the_driver
    test_slow_adapter_is_told_from_a_usual_one_and_from_a_dead_bus_and_still_read
    test_problems_found_at_connection_forbid_torque_until_they_are_gone
brown-out, servo reboot: LOST_TORQUE
    test_what_a_servo_reports_against_us_latches_in_one_tick
    test_settings_that_change_by_themselves_latch_in_one_tick
    test_no_goal_goes_out_while_a_servo_is_unheard_lest_it_wakes_one_that_restarted
    test_a_limp_servo_among_powered_ones_must_be_released_before_clearing
heat, voltage, load: HOT VOLTAGE OVERLOAD
    test_strain_sends_the_arm_to_rest_before_a_servo_trips
    test_the_way_to_rest_ends_where_torque_is_lost
tripped (torque limit 0): TRIPPED
    test_what_a_servo_reports_against_us_latches_in_one_tick
    test_a_limp_servo_among_powered_ones_must_be_released_before_clearing
blocked joint, stuck sensor: BLOCKED
    test_a_blocked_joint_latches_and_its_goal_becomes_its_position_once
EEPROM differs from the calibration, wheel mode: EEPROM_MISMATCH WRONG_MODEL
    test_eeprom_that_forbids_motion_is_shown_and_no_other
    test_other_model_is_named_and_its_table_not_judged
    test_servo_of_another_model_is_named_and_torque_refused
goal outside limits, NaN, inf: LIMIT
    test_a_run_that_must_not_be_is_refused_before_the_wire
    test_a_jog_that_means_nothing_is_refused
    test_goal_that_is_no_whole_tick_is_refused_before_the_wire
torque-on jump: JUMP_REFUSED
    test_any_surprise_while_torque_comes_on_backs_out
    test_torque_on_is_refused_for_a_moving_arm_and_outside_the_limits
torque on while limp: NOT_LIMP
    test_a_servo_that_stays_stiff_in_teaching_is_a_fault
    test_torque_that_appears_while_teaching_is_a_fault
    test_torque_that_appears_or_stays_on_a_limp_arm_is_a_fault
start pose differs by over 2 deg: START_MISMATCH
    test_a_run_that_must_not_be_is_refused_before_the_wire
    test_start_tolerance_is_the_documented_two_degrees
clock step: CLOCK_STEP
    test_a_step_of_the_wall_clock_is_told_and_changes_no_time
late ticks: LATE
    test_late_ticks_are_skipped_and_never_made_up_for_in_a_burst
    test_at_100_hz_a_tick_that_is_half_a_period_late_is_skipped_too
    test_a_late_tick_stops_the_motion
    test_whatever_stops_a_motion_stops_a_jog
SIGTERM:
    test_sigterm_stops_the_arm_closes_the_log_and_leaves_torque_on
    test_sigterm_stops_the_arm_closes_the_log_and_leaves_torque_on
SIGKILL of any process: RESTARTED
    test_a_new_loop_adopts_a_holding_arm_without_moving_it
    test_leaving_waits_until_the_motion_has_come_to_rest
    test_a_dead_control_process_fails_the_run_and_another_takes_the_arm_over
    test_killed_control_process_stops_the_arm_and_another_adopts_it
    test_killed_host_stops_the_arm_and_the_next_recovers_log_and_arm
power lost while logging:
    test_a_cut_loses_the_chunk_it_hits_and_nothing_else
    test_recovery_of_cuts_at_random_places_is_finished_true_and_says_what_was_lost
    test_the_start_recovers_every_part_but_those_being_written
disk full, folder unwritable: NO_SPACE
    test_a_full_disk_stops_recording_and_nothing_else
    test_an_unwritable_folder_is_a_problem_and_no_exception
client dies while teaching: ORPHAN_TAKE
    test_a_client_that_leaves_while_teaching_leaves_a_limp_arm_and_its_take
    test_a_control_process_that_dies_while_teaching_leaves_the_take_to_be_kept
    test_closing_keeps_the_take_under_way
slow subscriber:
    test_a_slow_subscriber_loses_the_oldest_and_is_told_how_many
    test_a_subscriber_that_takes_nothing_is_cut
flood, huge or deep JSON: RATE_LIMIT
    test_a_flood_is_refused_and_stop_is_served_to_the_flooder_and_to_others
    test_stop_is_served_within_100_ms_under_a_flood
    test_an_overlong_line_is_answered_and_the_connection_closed
    test_nesting_is_bounded
    test_numbers_are_finite
    test_a_key_stands_once_at_every_level
    test_clients_are_known_by_process_and_user
two clients command: BUSY
    test_one_client_commands_and_the_other_is_told_who
    test_a_jog_is_one_client_s_until_it_ends
    test_anyone_may_stop_a_run_and_the_run_says_so
    test_anyone_may_pause_a_run_and_its_own_user_goes_on
log of another arm: FOREIGN_LOG
    test_a_refused_preflight_tells_every_reason_and_moves_nothing
"""
# Each a line with name and codes, and a line for each test.
ROWS = [row.splitlines() for row in re.split(r"\n(?! )", MATRIX.strip())]


@pytest.mark.parametrize("row", ROWS, ids=lambda row: row[0])
def test_every_row_has_tests_that_exist(row: list[str]) -> None:
    tests = {line.strip() for line in row[1:]}
    assert tests, f"{row[0]}: nothing proves it"
    assert tests <= FUNCTIONS, f"{row[0]}: {tests - FUNCTIONS} are not there"


def test_every_fault_that_can_latch_stands_in_a_row() -> None:
    assert set(faults.CODES) <= {code for row in ROWS for code in row[0].split(":")[1].split()}
