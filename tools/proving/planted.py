"""The planted bugs: what each is, where it is looked for, and its edits of the syntax tree."""

from dataclasses import replace

from proving.mutants import Mutant
from proving.syntax import Edit

CONTROL, BUS, TRAJECTORY = "control", "dynamixel", "trajectory"
OUTPUTS = "tests/recording/test_outputs.py"


def _m(name: str, room: str, *edits: tuple[str, str]) -> Mutant:
    return Mutant(name, room, tuple(Edit(old, new) for old, new in edits))


def _log(name: str, *edits: tuple[str, str], room: str = "recording", tests: str = OUTPUTS) -> Mutant:
    return replace(_m(name, room, *edits), tests=tests)


# fmt: off
MUTANTS: tuple[Mutant, ...] = (
    # ------------------------------------------------------------------------------------------ goals and speeds
    _m("goals are not clamped", CONTROL, (
        "[min(max(__tick, __joint.low_tick), __joint.high_tick) for __joint, __tick in __pairs]",
        "[__tick for __joint, __tick in __pairs]")),
    _m("limits of the joint beside", CONTROL, (
        "[min(max(__tick, __joint.low_tick), __joint.high_tick)"
        " for __joint, __tick in zip(__wire, __ticks, strict=True)]",
        "[min(max(__tick, __joint.low_tick), __joint.high_tick)"
        " for __joint, __tick in zip(__wire[-1:] + __wire[:-1], __ticks, strict=True)]")),
    _m("speed 0 is written", CONTROL, (
        "min(max(__least, __speed), __joint.speed_limit_units)",
        "0 * min(max(__least, __speed), __joint.speed_limit_units)")),
    _m("speed is not limited", CONTROL, (
        "min(max(__least, __speed), __joint.speed_limit_units)", "max(__least, __speed, 700)")),
    _m("sign of direction", CONTROL, (
        "round(__joint.zero_tick + __joint.direction * __q / __tick_rad)",
        "round(__joint.zero_tick - __joint.direction * __q / __tick_rad)")),
    _m("goals two ticks further ahead", CONTROL,
       ("__q = __sample(__trajectory, __time_s)\nreturn __s.whole_ticks(__q)",
        "__q = __sample(__trajectory, __time_s + 2.0 * __s.period_s)\nreturn __s.whole_ticks(__q)"),
       ("if __share < 1.0:\n    __to_s = __motion.progress_s + __way\n    ...",
        "if __share < 0.0:\n    __to_s = __motion.progress_s + __way\n    ...")),
    _m("the lead is not bounded", CONTROL, (
        "__lead = math.radians(9.0) / __tick_rad", "__lead = math.radians(25.0) / __tick_rad")),
    _m("a hold rewrites goal := measured each tick", CONTROL, (
        "if __lost and __s.fresh:\n    __s.send_goal(__goal)",
        "if __s.fresh:\n"
        "    __s.send_goal([r.position if r else g for r, g in zip(__s.servos, __goal, strict=True)])")),
    _m("a stale sample is used", CONTROL,
       ("__m.stop_code or __m.paused or not __s.fresh", "__m.stop_code or __m.paused"),
       ("if not __s.fresh:\n    return None\n__progress = min(__way, __end)", "__progress = min(__way, __end)")),

    # -------------------------------------------------------------------------------------------- stops and ends
    _m("a stop is forgotten", CONTROL, (
        "if __moving is not None and not __moving.stop_code:\n    __moving.stop_code = __code",
        "if __moving is not None and not __moving.stop_code:\n    __moving.stop_code = ''")),
    _m("a pause is ignored", CONTROL, ("__m.stop_code or __m.paused or __unheard", "__m.stop_code or __unheard")),
    _m("the host's death is ignored", CONTROL, ("__s.finish_motion('HOST_LOST', __text)", "None")),
    _m("a late tick is ignored", CONTROL, ("__s.stop_motion('LATE')", "None")),
    _m("late ticks are made up for in a burst", CONTROL, (
        "if __behind_ns > __loop._skip_ns:\n    ...", "if __behind_ns > 10**15:\n    ...")),
    _m("a jog goes on by itself", CONTROL, ("__bound_ns = 80_000_000", "__bound_ns = 8_000_000_000")),

    # ---------------------------------------------------------------------------------------------------- faults
    _m("a fault cuts torque", CONTROL, (
        "__s.events.append(Event('error', __code, __text, __servo_id))", "__s.torque_off()")),
    _m("a trip is not latched", CONTROL, (
        "if __servo.torque_limit == 0:\n    ...", "if __servo.torque_limit < 0:\n    ...")),
    _m("a restart is not noticed", CONTROL,
       ("if not __servo.torque_enabled:\n    ...", "if __servo.torque_enabled > 9:\n    ..."),
       ("if __servo.settings != __known:\n    ...", "if __servo.settings < 0:\n    ...")),
    _m("silence latches too late", CONTROL, ("SILENT_AGE_S = 0.5", "SILENT_AGE_S = 5.0")),
    _m("a blocked joint is not latched", CONTROL, ("__for_ns >= BLOCKED_NS", "__for_ns >= 99 * BLOCKED_NS")),
    _m("a lost port is not latched", CONTROL, (
        "if not __s.inputs.sample.port_open:\n    ...", "if __s.inputs.tick < 0:\n    ...")),
    _m("a lost port is looked for too seldom", CONTROL, ("__every_ns = NS_PER_S // 2", "__every_ns = NS_PER_S * 8")),
    _m("another writer is not noticed", CONTROL, (
        "if __servo.goal != __goal:\n    if __servo.goal != __previous:\n        ...\n    __lost = True",
        "if __servo.goal != __goal:\n    if __servo.goal < 0:\n        ...\n    __lost = True")),
    _m("heat is not noticed", CONTROL, (
        "__joint.temperature_degC >= __limit_degC or __alarm", "__joint.temperature_degC >= 999 or __alarm")),
    _m("voltage is not noticed", CONTROL, (
        "not __low_V <= __joint.voltage_V <= __high_V or __alarm", "not 0 <= __joint.voltage_V or __alarm")),
    _m("clear while the cause lasts", CONTROL, (
        "__causes = '; '.join(__texts)\nif __causes:\n    ...", "__causes = ''")),
    _m("a run while a fault is latched", CONTROL, (
        "{T.RELEASE: P.FAULTED}", "{T.RELEASE: P.FAULTED, T.RUN: P.MOVING}")),
    _m("torque on while a fault is latched", CONTROL, (
        "{T.RELEASE: P.FAULTED}", "{T.RELEASE: P.FAULTED, T.TORQUE_ON: P.PREPARING}")),

    # ---------------------------------------------------------------------------------------------------- torque
    _m("a goal follows torque-off", CONTROL, (
        "__s.goal = None\n__s.write_all(ax12a.TORQUE_ENABLE, 0)",
        "__s.goal = Goal(__s.state.goal, (16,) * len(__s.state.goal)) if __s.state.goal else None\n"
        "__s.write_all(ax12a.TORQUE_ENABLE, 0)")),
    _m("torque-on without a goal", CONTROL, (
        "__s.send_goal(__ticks)\n__state.request_id, __state.anchor = __request_id, tuple(__ticks)",
        "held = tuple(r.goal for r in __s.servos if r)\n__state.request_id, __state.anchor = __request_id, held")),
    _m("torque-on without a soft limit", CONTROL, (
        "(__r, __s, __t, __u, (ax12a.PUNCH, __punch), (ax12a.TORQUE_LIMIT, SOFT_TORQUE))",
        "(__r, __s, __t, __u, (ax12a.PUNCH, __punch))")),
    _m("torque-on at a goal of its own", CONTROL, (
        "__ticks.append(min(max(__position, __low), __high))",
        "__ticks.append(min(max(__position + 9, __low), __high))")),
    _m("an EEPROM write in service", CONTROL, (
        "__limit = round(__rising)\n__s.write(__servo_id, ax12a.TORQUE_LIMIT, __limit)",
        "__limit = round(__rising)\n__s.write(__servo_id, ax12a.MAX_TORQUE, __limit)")),
    _m("adoption rewrites the goals", CONTROL, (
        "__s.go(Trigger.ADOPT_POWERED)\n__s.take_over()",
        "__s.go(Trigger.ADOPT_POWERED)\n__s.take_over()\n"
        "__s.send_goal([r.position for r in __s.servos if r is not None])")),
    _m("settling without seeing the rest pose", CONTROL, (
        "__away <= REST_TOLERANCE_RAD", "__away <= 99.0 * REST_TOLERANCE_RAD")),
    _m("settling too fast", "trajectory", (
        "APPROACH_SPEED_RAD_S = math.radians(20.0)", "APPROACH_SPEED_RAD_S = 0.9")),

    # -------------------------------------------------------------------------------- what may not be asked for
    _m("a run may start anywhere", CONTROL, ("START_TOLERANCE_RAD = __bound", "START_TOLERANCE_RAD = 9.0")),
    _m("joint speed is not checked", CONTROL, ("__speed > __joint.speed_limit_rad_s * __slack", "__speed > 1e9")),
    _m("NaN is not refused", CONTROL, (
        "len(__point) != __n or not all(map(math.isfinite, __point))", "len(__point) != __n")),

    # ------------------------------------------------------------------------------------------------------- bus
    _m("no retry", BUS, ("__retries < SAMPLE_RETRIES", "__retries < 0")),
    _m("a lost reply looks fresh", BUS, (
        "replace(__track.reading, fresh=False, problem=__problem)",
        "replace(__track.reading, fresh=True, stamp_ns=__track.reading.stamp_ns + 100_000_000)")),
    _m("goals of the joints beside", BUS, (
        "zip(__bus.servo_ids, __goal.ticks, __goal.speeds, strict=True)",
        "zip(__bus.servo_ids, __goal.ticks[1:] + __goal.ticks[:1], __goal.speeds, strict=True)")),
    _m("the EEPROM is not compared", BUS,
       ("__cw == __ccw == 0", "__cw < 0"),
       ("if __ccw < __high:\n    __faults.append(__text)", "if __ccw < 0:\n    __faults.append(__text)")),

    # ------------------------------------------------------------- what no episode shows: what is logged, and replay
    _log("replay leaves out writes", (
        "if __topic not in __replay.not_compared:\n    ...",
        "if __topic not in (*__replay.not_compared, '/armctl/writes'):\n    ...")),
    _log("replay leaves out mode and faults", (
        "if __topic not in __replay.not_compared:\n    ...",
        "if __topic not in (*__replay.not_compared, '/armctl/cycle'):\n    ...")),
    _log("replay leaves out goals", (
        "if __topic not in __replay.not_compared:\n    ...",
        "if __topic not in (*__replay.not_compared, '/joint_commands'):\n    ...")),
    _log("the mode is not logged", ("{'mode': __mode, 'faults': __faults}", "{'mode': 'off', 'faults': __faults}")),
    _log("faults are logged without their servo", ("{'servo_id': __servo_id}", "{'servo_id': -1}")),
    _log("writes are logged as confirmed", ("{'confirmed': __done}", "{'confirmed': True}")),
    _log("confirmations are thrown away", (
        "[__bus.write(__write) for __write in __writes]", "[__bus.write(__write) or True for __write in __writes]"),
        room=CONTROL, tests="tests/control/test_loop.py"),
    # ----------------------------------------------- those that an independent trial planted, of which few were seen
    _m("error bits of another servo", BUS, (
        "__packet, __problem = __bus._exchange(__track.request, __size)\nif __problem:\n    return __problem\n"
        "__data, __error = __packet[DATA_AT:-1], __packet[ERROR_AT]",
        "__packet, __problem = __bus._exchange(__track.request, __size)\nif __problem:\n    return __problem\n"
        "__data, __error = __packet[DATA_AT:-1], __bus._tracks[0].reading.error")),
    _m("limits of via points are skipped", TRAJECTORY, (
        "(float(__column.min()), float(__column.max()))",
        "(float(min(__column[0], __column[-1])), float(max(__column[0], __column[-1])))")),
    _m("direction is dropped in speed and load", CONTROL,
       ("__joint.direction * __servo.speed_rad_s", "__servo.speed_rad_s"),
       ("__joint.direction * __servo.load_ratio", "__servo.load_ratio")),
    _m("two servos that are silent at once", CONTROL, (
        "__s.latch_servo('SERVO_SILENT', __silent[0], __text)",
        "len(__silent) == 1 and __s.latch_servo('SERVO_SILENT', __silent[0], __text)")),
    _m("a goal that is read back may be 60 ticks off", CONTROL, (
        "if __servo.goal != __goal:\n    if __servo.goal != __previous:\n        ...\n    __lost = True",
        "if __servo.goal != __goal:\n    if abs(__servo.goal - __previous) > 60:\n        ...\n    __lost = True")),
    _m("a limit is off by one", CONTROL, (
        "[min(max(__tick, __joint.low_tick), __joint.high_tick) for __joint, __tick in __pairs]",
        "[min(max(__tick, __joint.low_tick - 1), __joint.high_tick + 1) for __joint, __tick in __pairs]")),
    _m("a fault is cleared without looking who is there", CONTROL, (
        "not (__due or __first or __clearing)", "not (__due or __first)")),
    _m("a jog never ends", CONTROL, (
        "return __s.finish_jog(__jog.stop_code or 'NO_HEARTBEAT')", "return None")),
    _m("overload is never seen", CONTROL, ("LOAD_RATIO = 0.8", "LOAD_RATIO = 1.8")),
    _m("a blocked joint is not relieved", CONTROL, (
        "__s.send_goal([__servo.position for __servo in __s.servos if __servo])", "None")),
    _m("a stop on the way to rest is lost", CONTROL, (
        "if __s.state.phase in TO_REST:\n    give_up_rest(__s, __code, __why)\n__s.stop_motion(__code)",
        "if __s.state.phase not in TO_REST:\n    __s.stop_motion(__code)")),
    _m("a garbled reading counts as fresh", BUS, (
        "if int.from_bytes(__data, 'little') & IMPOSSIBLE_BITS:\n    ...\n__now_ns = __bus.port.arrived_ns",
        "__now_ns = __bus.port.arrived_ns"),
       ("sum(__port._received[:__size]) & 255 == WHOLE_SUM", "sum(__port._received[:__size]) >= 0")),
    _m("contact along the path is not looked at", TRAJECTORY, (
        "_against_contact(_every_degree(__q, __period_s, __arm), __arm, __robot)",
        "_against_contact(__q[::len(__q) - 1], __arm, __robot)")),

    # ------------------------------------------------------------------------------------ what the host lets through
    _m("the host does not look at the floor", TRAJECTORY, (
        "len(__too_low_m) and __too_low_m.min() < -SAME_M", "len(__too_low_m) and __too_low_m.min() < -9.0")),
    _m("the host does not look at links that touch", TRAJECTORY, (
        "np.flatnonzero(__gap_m < __bound_m - SAME_M)", "np.flatnonzero(__gap_m < __bound_m - 9.0)")),
    _m("the host does not look at the tool's speed", TRAJECTORY, (
        "(peak_tool_speed(__tool_m, __period_s), __arm.tool_speed_limit_m_s)",
        "(peak_tool_speed(__tool_m, __period_s), 9.0 * __arm.tool_speed_limit_m_s)")),
    _m("the host does not look at joint speeds", TRAJECTORY, (
        "(float(__speed[__i]), __joint.speed_limit_deg_s, 'deg/s', 1.0)",
        "(0.0, __joint.speed_limit_deg_s, 'deg/s', 1.0)")),
    _m("the control process does not look at limits", CONTROL, (
        "not __low - ax12a.TICK_RAD <= __worst <= __high + ax12a.TICK_RAD", "not -9.0 <= __worst <= 9.0")),

    # ------------------------------------------------------------------------------------------------ what is told
    _m("a fault names the servo beside", CONTROL, (
        "__joint = __s.arm.joints[__index]\n__s.latch(__code, __text, __joint.servo_id)",
        "__joint = __s.arm.joints[__index - 1]\n__s.latch(__code, __text, __joint.servo_id)")),
    _m("direction is dropped in position", CONTROL, (
        "__joint.direction * (__servo.position - __joint.zero_tick) * __tick_rad",
        "(__servo.position - __joint.zero_tick) * __tick_rad")),
    _m("a limp arm that has torque is not noticed", CONTROL, (
        "__reading.fresh and __servo is not None and __servo.torque_enabled",
        "__reading.fresh and __servo is not None and __servo.torque_enabled > 9")),
    _m("teaching begins before the arm is limp", CONTROL, (
        "__s.fresh and not any((__servo is None or __servo.torque_enabled for __servo in __s.servos))", "True")),
    _m("parked, and torque stays on", CONTROL, (
        "__s.torque_off()\n__s.events.append(Event('info', 'PARKED', __text))",
        "__s.events.append(Event('info', 'PARKED', __text))")),
    _m("the silence of the daemon is ignored", CONTROL, ("_slow_down(__s, 'HOST_SILENT', __text)", "None")),

    # ------------------------------------------------------------------------------------------------- more of faults
    _m("a supply that is too low is not noticed", CONTROL, (
        "not __low_V <= __joint.voltage_V <= __high_V or __alarm", "__joint.voltage_V > __high_V")),
    _m("strain one way round is not noticed", CONTROL, (
        "abs(__joint.load_ratio) > LOAD_RATIO", "__joint.load_ratio > LOAD_RATIO")),
    _m("cleared while a servo is hot", CONTROL, (
        "[__now.temperature_degC >= __limit_degC for __now in __s.joints]", "[False for __now in __s.joints]")),
    _m("cleared while a servo is silent", CONTROL, (
        "[not __now.known or __now.age_s > PAUSE_AGE_S for __now in __s.joints]", "[False for __now in __s.joints]")),
    _m("servos that are limp beside others are adopted", CONTROL, (
        "__s.latch_servo('LOST_TORQUE', __powered.index(False), __text)",
        "(__s.go(Trigger.ADOPT_POWERED), __s.take_over())")),
    _m("the torque limit rises at once", CONTROL, ("RAMP_S = 0.5", "RAMP_S = 0.01")),
    _m("a jog is three times as fast", CONTROL, (
        "SPEED_RAD_S = math.radians(20.0)", "SPEED_RAD_S = math.radians(95.0)")),
    _m("the id of a reply is not looked at", BUS, ("__reply[:3] == __request[:3]", "__reply[:2] == __request[:2]")),
    _m("the last servo gets no goal", BUS, (
        "zip(__bus.servo_ids, __goal.ticks, __goal.speeds, strict=True)",
        "zip(__bus.servo_ids[:-1], __goal.ticks, __goal.speeds)")),
    _m("a run goes on from where it is not", CONTROL, ("__away > START_TOLERANCE_RAD", "__away > 9.0")),
)
# fmt: on
