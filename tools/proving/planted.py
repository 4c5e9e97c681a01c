"""The planted bugs: what each is, where it is looked for, and its edits of the syntax tree."""

from dataclasses import replace

from proving.mutants import Mutant
from proving.syntax import Edit

CONTROL, BUS, TRAJECTORY = "control", "dynamixel", "trajectory"
OUTPUTS, PLACE = "tests/recording/test_outputs.py", "tests/proving/test_place.py::"


def _m(name: str, room: str, *edits: tuple[str, str]) -> Mutant:
    return Mutant(name, room, tuple(Edit(old, new) for old, new in edits))


def _log(name: str, *edits: tuple[str, str], room: str = "recording", tests: str = OUTPUTS) -> Mutant:
    return replace(_m(name, room, *edits), tests=tests)


# The three questions of `_overruled`, whatever they latch.
OVERRULED = (
    "if {}:\n    __trip\nelif {}:\n    __limp\nelif {}:\n    return False\nelif __restarted:\n    __restart\n"
    "else:\n    __changed"
)
MAY_REST = "__s.arm.rest_on_strain and (not __s.state.stays) and __s.state.powered and __s.all_powered()"
LET_GO = "__state.powered, __state.looks, __state.borne_ratio = (False, (), ())"


# fmt: off
MUTANTS: tuple[Mutant, ...] = (
    # ------------------------------------------------------------------------------------------ goals and speeds
    _m("speed 0 is written", CONTROL, (
        "min(max(MINIMUM_SPEED_UNITS, __speed), __most)", "0 * min(max(MINIMUM_SPEED_UNITS, __speed), __most)")),
    _m("speed is not limited", CONTROL, (
        "min(max(MINIMUM_SPEED_UNITS, __speed), __most)", "max(MINIMUM_SPEED_UNITS, __speed, 700)")),
    _m("sign of direction", CONTROL, (
        "__joint.zero_tick + __joint.direction * (__q + __given) / TICK_RAD",
        "__joint.zero_tick - __joint.direction * (__q + __given) / TICK_RAD")),
    _m("goals two ticks further ahead", CONTROL,
       ("sample_trajectory(__motion.trajectory, __time_s + __d)",
        "sample_trajectory(__motion.trajectory, __time_s + 0.2 + __d)"),
       ("if __share < 1.0:\n    __to_s = __motion.progress_s + __way\n    ...",
        "if __share < 0.0:\n    __to_s = __motion.progress_s + __way\n    ...")),
    _m("the lead is not bounded", CONTROL, (
        "__lead = math.radians(9.0) / __tick_rad", "__lead = math.radians(25.0) / __tick_rad")),
    _m("a hold rewrites goal := measured each tick", CONTROL, (
        "if __sure := [__i for __i in __owed if __i not in __unsure]:\n    _send(__s, __sure, to_all=not __unsure)",
        "if __s.fresh and __s.all_powered():\n    __s.send_goal([servo.position for servo in __s.servos if servo])")),
    _m("a stale sample is used", CONTROL,
       ("_nearer(__rate, __wanted if __s.fresh else 0.0, __s.period_s)", "_nearer(__rate, __wanted, __s.period_s)"),
       ("if not __s.fresh or __stands:\n    return None\nif __running:\n    trim(__s)",
        "if __stands:\n    return None\nif __running:\n    trim(__s)")),

    # -------------------------------------------------------------------------------------------- stops and ends
    _m("a stop is forgotten", CONTROL, (
        "if __moving is not None and not __moving.stop_code:\n    __moving.stop_code = __code",
        "if __moving is not None and not __moving.stop_code:\n    __moving.stop_code = ''")),
    _m("a pause is ignored", CONTROL, (
        "0.0 if __m.stop_code or __m.paused else __m.wanted_rate", "0.0 if __m.stop_code else __m.wanted_rate")),
    _m("the host's death is ignored", CONTROL, ("__s.finish_motion('HOST_LOST', __text)", "None")),
    _m("a late tick is ignored", CONTROL, ("__s.stop_motion('LATE')", "None")),
    _m("late ticks are made up for in a burst", CONTROL, (
        "if __behind_ns > __loop._skip_ns:\n    ...", "if __behind_ns > 10**15:\n    ...")),
    _m("a jog goes on by itself", CONTROL, ("__bound_ns = 80_000_000", "__bound_ns = 8_000_000_000")),

    # ---------------------------------------------------------------------------------------------------- faults
    _m("a fault cuts torque", CONTROL, (
        "__s.events.append(Event('error', __code, __text, __servo_id))",
        "__s.write_all(ax12a.TORQUE_ENABLE, 0)")),
    _m("a trip is not latched", CONTROL, (
        OVERRULED.format("__servo.torque_limit == 0", "not __servo.torque_enabled", "__settings"),
        OVERRULED.format("__servo.torque_limit < 0", "not __servo.torque_enabled", "__settings"))),
    _m("a restart is not noticed", CONTROL, (
        OVERRULED.format("__servo.torque_limit == 0", "not __servo.torque_enabled", "__settings"),
        OVERRULED.format("__servo.torque_limit == 0", "__servo.torque_enabled > 9", "True"))),
    _m("silence latches too late", CONTROL, ("SILENT_AGE_S = 0.5", "SILENT_AGE_S = 5.0")),
    _m("a blocked joint is not latched", CONTROL, (
        "_lasts(__s, __since_ns[__i], BLOCKED_S)", "_lasts(__s, __since_ns[__i], 99.0 * BLOCKED_S)")),
    _m("a lost port is not latched", CONTROL, (
        "if not __s.inputs.sample.port_open:\n    __s.latch('PORT_GONE', __text)\n    return", "")),
    _m("a lost port is looked for too seldom", CONTROL, ("__every_ns = NS_PER_S // 2", "__every_ns = NS_PER_S * 8")),
    _m("another writer is not noticed", CONTROL, (
        "__s.latch_servo('OTHER_WRITER', __i, f'{__found}: another program writes to the bus')", "None")),
    _m("heat is not noticed", CONTROL, (
        "__joint.temperature_degC >= __limit_degC or __alarm", "__joint.temperature_degC >= 999 or __alarm")),
    _m("a run while a fault is latched", CONTROL, (
        "{T.RELEASE: P.FAULTED}", "{T.RELEASE: P.FAULTED, T.RUN: P.MOVING}")),
    _m("torque on while a fault is latched", CONTROL, (
        "{T.RELEASE: P.FAULTED}", "{T.RELEASE: P.FAULTED, T.TORQUE_ON: P.PREPARING}")),

    # ---------------------------------------------------------------------------------------------------- torque
    _m("a goal follows torque-off", CONTROL, (
        "__s.forget_goals()\n__powered\n__s.write_all(ax12a.TORQUE_ENABLE, 0)".replace("__powered", LET_GO),
        "held = __state.goal\n__s.forget_goals()\n__powered\n__s.write_all(ax12a.TORQUE_ENABLE, 0)\n"
        "__s.goal = Goal(held, (16,) * len(held)) if held else None".replace("__powered", LET_GO))),
    _m("torque-on without a goal", CONTROL,
       ("__s.go(Trigger.SOFT_SEEN if __soft else Trigger.SHAFT_MOVED)\n__s.send_goal(__state.anchor)",
        "__s.go(Trigger.SOFT_SEEN if __soft else Trigger.SHAFT_MOVED)"),
       ("__s.write_all(ax12a.TORQUE_ENABLE, 1)\n__s.send_goal(__anchor)", "__s.write_all(ax12a.TORQUE_ENABLE, 1)"),
       ("__preparing and (not ax12a.register_value(ax12a.MOVING_SPEED, __registers))", "False"),
       ("not __softening and abs(__servo.goal - __anchor) > __most", "False")),
    _m("torque-on without a soft limit", CONTROL, (
        "(__r, __s, __t, __u, (ax12a.PUNCH, __punch), (ax12a.TORQUE_LIMIT, SOFT_TORQUE))",
        "(__r, __s, __t, __u, (ax12a.PUNCH, __punch))")),
    _m("torque-on at a goal of its own", CONTROL,
       ("(__state.request_id, __state.anchor) = (__request_id, tuple(__ticks))",
        "(__state.request_id, __state.anchor) = (__request_id, tuple([tick + 9 for tick in __ticks]))"),
       ("__s.limp_shaft(__index, __state.anchor[__index])",
        "__s.limp_shaft(__index, __state.anchor[__index] - 9)._replace(tick=__state.anchor[__index])")),
    _m("an EEPROM write in service", CONTROL, (
        "__limit = round(__rising)\n__s.write(__servo_id, ax12a.TORQUE_LIMIT, __limit)",
        "__limit = round(__rising)\n__s.write(__servo_id, ax12a.MAX_TORQUE, __limit)")),
    _m("adoption rewrites the goals", CONTROL, (
        "__s.go(Trigger.ADOPT_POWERED)",
        "(__s.go(Trigger.ADOPT_POWERED), "
        "__s.send_goal([r.position for r in __s.servos if r is not None]))")),
    _m("settling without seeing the rest pose", CONTROL, (
        "__away <= REST_TOLERANCE_RAD", "__away <= 99.0 * REST_TOLERANCE_RAD")),
    _m("settling too fast", "trajectory", (
        "APPROACH_SPEED_RAD_S = math.radians(20.0)", "APPROACH_SPEED_RAD_S = 0.9")),

    # -------------------------------------------------------------------------------- what may not be asked for
    _m("a run may start anywhere", CONTROL, ("START_TOLERANCE_RAD = __bound", "START_TOLERANCE_RAD = 9.0")),
    _m("joint speed is not checked", CONTROL, ("__speed > __joint.speed_limit_rad_s * __slack", "__speed > 1e9")),
    _m("NaN is not refused", CONTROL, (
        "len(__point) != len(__arm.joints) or not all(map(math.isfinite, __point))",
        "len(__point) != len(__arm.joints)")),

    # ------------------------------------------------------------------------------------------------------- bus
    _m("no retry", BUS, ("__retries < SAMPLE_RETRIES", "__retries < 0")),
    _m("a lost reply looks fresh", BUS, (
        "replace(__track.reading, fresh=False, problem=__problem)",
        "replace(__track.reading, fresh=True, stamp_ns=__track.reading.stamp_ns + 100_000_000)")),
    _m("goals of the joints beside", BUS, (
        "zip(__bus.servo_ids, __goal.ticks, __goal.speeds, strict=True)",
        "zip(__bus.servo_ids, __goal.ticks[1:] + __goal.ticks[:1], __goal.speeds, strict=True)")),
    _m("the EEPROM is not compared", BUS, ("if not __unfit:\n    return []", "if True:\n    return []")),

    # ------------------------------------------------------------- what no episode shows: what is logged, and replay
    _log("replay leaves out writes", (
        "if __topic not in __replay.not_compared:\n    ...",
        "if __topic not in (*__replay.not_compared, '/armctl/writes'):\n    ...")),
    _log("the mode is not logged", (
        "{'mode': __mode, 'wanted': __q, 'faults': __faults}", "{'mode': 'off', 'wanted': __q, 'faults': __faults}")),
    _log("faults are logged without their servo", (
        "__fault['servo_id'] = -1 if __fault['servo_id'] is None else __fault['servo_id']",
        "__fault['servo_id'] = -1")),
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
        "__s.latch_servo('SERVO_SILENT', __i, __text)",
        "len(silent) == 1 and __s.latch_servo('SERVO_SILENT', __i, __text)")),
    _m("a goal that is read back may be 60 ticks off", CONTROL, (
        "__shown == __s.state.goal[__i] or any((__goal[__i] == __shown for __goal in __s.state.sent))",
        "any(abs(goal[__i] - __shown) <= 60 for goal in (__s.state.goal, *__s.state.sent))")),
    _m("a limit is off by one", CONTROL, (
        "min(max(__tick, __x.low_tick), __x.high_tick)", "min(max(__tick, __x.low_tick - 1), __x.high_tick + 1)")),
    _m("a fault is cleared without looking who is there", CONTROL, (
        "__due or __x._tick == 0 or (any(__clears) and __x._identification is None)", "__due or __x._tick == 0")),
    _m("a jog never ends", CONTROL, (
        "__s.finish_jog(__jog.stop_code or 'NO_HEARTBEAT')", "None")),
    _m("overload is never seen", CONTROL, ("LOAD_RATIO = 0.8", "LOAD_RATIO = 1.8")),
    _m("a blocked joint is not relieved", CONTROL, (
        "if __s.latch_servo('BLOCKED', __i, __found):\n    relieve(__s, __s.wire[__i].of)\nelif __latched:\n    ...",
        "if __s.latch_servo('BLOCKED', __i, __found):\n    __s.state.looks = ()")),
    _m("a stop on the way to rest is lost", CONTROL, (
        "if __s.state.phase in TO_REST:\n    __s.give_up_rest(__code, __why)\n__s.stop_motion(__code)",
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
        "__too_fast(__joint.name, __fast, __joint.speed_limit_deg_s, 'deg/s', 1.0, __duration_s)",
        "__too_fast(__joint.name, 0.0, __joint.speed_limit_deg_s, 'deg/s', 1.0, __duration_s)")),
    _m("the control process does not look at limits", CONTROL, (
        "not __low - ax12a.TICK_RAD <= __worst <= __high + ax12a.TICK_RAD", "not -9.0 <= __worst <= 9.0")),

    # ------------------------------------------------------------------------------------------------ what is told
    _m("a fault names the servo beside", CONTROL, (
        "__servo = __s.wire[__index]\nreturn __s.latch(__code, __text, __servo.servo_id)",
        "__servo = __s.wire[__index - 1]\nreturn __s.latch(__code, __text, __servo.servo_id)")),
    _m("direction is dropped in position", CONTROL, (
        "__joint.position_rad(__servo.position)",
        "(__servo.position - __joint.zero_tick) * ax12a.TICK_RAD")),
    _m("a limp arm that has torque is not noticed", CONTROL, (
        "__i not in __stiff and (__servo := __s.heard(__i)) and __servo.torque_enabled",
        "__i not in __stiff and (__servo := __s.heard(__i)) and __servo.torque_enabled > 9")),
    _m("teaching begins before the arm is limp", CONTROL, (
        "__s.go(Trigger.TEACH)\n__s.let_go(__request_id)",
        "__s.go(Trigger.TEACH)\n__s.let_go()\n__s.reply(__request_id, True)\n__s.go(Trigger.LIMP_SEEN)")),
    _m("parked, and torque stays on", CONTROL, (
        "__s.go(Trigger.PARKED)\n__s.let_go(__state.request_id)",
        "__s.go(Trigger.PARKED)\n__s.reply(__state.request_id, True)\n"
        "__state.phase = Phase.OFF if __state.phase is Phase.RELEASING else __state.phase")),
    _m("the silence of the daemon is ignored", CONTROL, ("_slow_down(__s, 'HOST_SILENT', __text)", "None")),

    # ------------------------------------------------------------------------------------------------- more of faults
    _m("a supply that is too low is not noticed", CONTROL, (
        "not __low_V <= __joint.voltage_V <= __high_V or __alarm", "__joint.voltage_V > __high_V")),
    _m("strain one way round is not noticed", CONTROL, (
        "abs(__joint.load_ratio) > LOAD_RATIO", "__joint.load_ratio > LOAD_RATIO")),
    _m("cleared while a servo is hot", CONTROL, (
        "[__now.temperature_degC >= __limit_degC for __now in __s.each]", "[False for __now in __s.each]")),
    _m("cleared while a servo is silent", CONTROL,
       ("[not __now.known or __now.age_s > PAUSE_AGE_S for __now in __s.each]", "[False for __now in __s.each]"),
       ("for __problem in __s.state.problems:\n    ...",
        "for __problem in __s.state.problems[:0]:\n    ...")),
    _m("servos that are limp beside others are adopted", CONTROL, (
        "__s.latch_servo('LOST_TORQUE', __powered.index(False), __text)",
        "__s.go(Trigger.ADOPT_POWERED)")),
    _m("the torque limit rises at once", CONTROL, ("RAMP_S = 0.5", "RAMP_S = 0.01")),
    _m("a jog is three times as fast", CONTROL, (
        "SPEED_RAD_S = math.radians(20.0)", "SPEED_RAD_S = math.radians(95.0)")),
    _m("the id of a reply is not looked at", BUS, ("__reply[:3] == __request[:3]", "__reply[:2] == __request[:2]")),
    _m("the last servo gets no goal", BUS, (
        "zip(__bus.servo_ids, __goal.ticks, __goal.speeds, strict=True)",
        # From its third second on: without its first goal no torque comes on.
        "zip(__bus.servo_ids[:-1] if __bus._sample_count > 20 else __bus.servo_ids, __goal.ticks, __goal.speeds)")),

    # ------------------------------------------------------------------------ what was decided is sent until it is seen
    _m("release is answered before the arm is seen limp", CONTROL, (
        "if __state.motion is not None:\n    __s.finish_motion('RELEASED', '')\n__s.let_go(__request_id)",
        "if __state.motion is not None:\n    __s.finish_motion('RELEASED', '')\n"
        "__s.let_go()\n__s.reply(__request_id, True)")),
    _m("torque-off is written once only", CONTROL, (
        "if __heard or not __overdue:\n    __s.write(__servo_id, ax12a.TORQUE_ENABLE, 0)", "")),
    _m("who is not seen limp is never named", CONTROL, ("LIMP_NS = 500000000", "LIMP_NS = 10**15")),
    _m("one that is not heard counts as limp", CONTROL, (
        "(__servo := __s.heard(__i)) is None or __servo.torque_enabled",
        "(__servo := __s.heard(__i)) is not None and __servo.torque_enabled")),
    _m("goals are sent while one is let go", CONTROL,
       ("if __s.state.letting_go is not None:\n    return\n__goal = __clamped", "__goal = __clamped"),
       ("__s.state.letting_go = replace(__going, stiff=tuple(__stiff))\nif __overdue:\n    ...",
        "__s.state.letting_go = replace(__going, stiff=tuple(__stiff))\nif None not in __s.servos:\n"
        "    __s.send_goal([servo.position for servo in __s.servos])\nif __overdue:\n    ...")),
    _m("a goal that was decided is sent once only", CONTROL, (
        "if __sure := [__i for __i in __owed if __i not in __unsure]:\n    _send(__s, __sure, to_all=not __unsure)",
        "if (__sure := [__i for __i in __owed if __i not in __unsure]) and __s.state.goal_ns == __s.inputs.now_ns:\n"
        "    _send(__s, __sure, to_all=not __unsure)")),
    _m("a foreign goal is left standing", CONTROL, (
        "__foreign = [__i for __i in __owed if not __s.is_from_here(__i)]",
        "__foreign = [__i for __i in __owed if not __s.is_from_here(__i)]\n"
        "__owed = [__i for __i in __owed if __s.is_from_here(__i)]")),
    _m("one led far off is brought back", CONTROL, (
        "LED_OFF_TICKS = math.radians(12.0) / __tick_rad", "LED_OFF_TICKS = math.radians(300.0) / __tick_rad")),
    _m("two goals that are lost are another program's", CONTROL, (
        "any((__goal[__i] == __shown for __goal in __s.state.sent))",
        "any((__goal[__i] == __shown for __goal in __s.state.sent[:1]))")),
    _m("the soft limit is not read back", CONTROL,
       ("if ax12a.register_value(__register, __registers) != __value:\n    __s.write(__servo_id, __register, __value)",
        "if not __s.state.ticks and ax12a.register_value(__register, __registers) != __value:\n"
        "    __s.write(__servo_id, __register, __value)"),
       ("(__softening or __preparing) and __servo.torque_limit != SOFT_TORQUE", "False")),

    # --------------------------------------------------------------------------- the way to rest, and what is behind it
    _m("rest is not announced", CONTROL, ("__state.ticks < __s.ticks_in(REST_AHEAD_S)", "False")),
    _m("rest after one hot reading", CONTROL, ("HEAT_S = 2.0", "HEAT_S = 0.0")),
    _m("rest that was called off begins again", CONTROL, (
        MAY_REST, "__s.arm.rest_on_strain and __s.state.powered and __s.all_powered()")),
    _m("the arm's file does not forbid the rest", CONTROL, (
        MAY_REST, "not __s.state.stays and __s.state.powered and __s.all_powered()")),
    _m("torque comes on while a servo is hot", CONTROL, ("{Cause.HEAT: 'HOT', Cause.SUPPLY: 'VOLTAGE'}", "{}")),
    _m("a fault hides behind the first", CONTROL, (
        "if any((__fault.code == __code and __same for __fault in __s.faults)):\n    return False",
        "if __s.faults:\n    return False")),
    _m("rest though a servo is silent", CONTROL,
       ("any((__kind.motion == 'ends' or __kind.until is Cause.SILENCE for __kind in __kinds))",
        "any((__kind.motion == 'ends' for __kind in __kinds))"),
       ("any((__joint.age_s > SILENT_AGE_S for __joint in __s.joints))", "False"),
       ("_nearer(__rate, __wanted if __s.fresh else 0.0, __s.period_s)",
        "_nearer(__rate, __wanted if __s.fresh or __s.state.phase == 'fault_going' else 0.0, __s.period_s)"),
       ("if not __s.fresh or __stands:\n    return None\nif __running:\n    trim(__s)",
        "if not (__s.fresh or __s.state.phase == 'fault_going') or __stands:\n    return None\n"
        "if __running:\n    trim(__s)")),
    _m("contact is told, and not relieved", CONTROL, (
        "if __s.latch_servo('CONTACT', __i, __text):\n    relieve(__s, __i)",
        "if __s.latch_servo('CONTACT', __i, __text):\n    __s.state.looks = ()")),
    _m("contact is never seen", CONTROL, ("PUSH_S = 2.0", "PUSH_S = 2000.0")),
    _m("no joint is relieved after a stop", CONTROL, (
        "if _is_too_far(__s, __i):\n    relieve(__s, __i)", "")),

    # ------------------------------------------------------------------------------ correction, seen by `prove place`
    _log("trim without bound",
         ("TRIM_RAD = math.radians(3.0)", "TRIM_RAD = math.radians(99.0)"),
         ("AWAY_RAD = math.radians(7.0)", "AWAY_RAD = math.radians(99.0)"),
         ("MOST_RAD = math.radians(7.0)", "MOST_RAD = math.radians(99.0)"),
         room=CONTROL, tests=PLACE + "test_the_goal_of_a_joint_that_is_held_keeps_its_bound"),
    _log("trim while latched",
         ("__f is None or not __f.corrected or (not __s.fresh) or (__s.state.phase in LATCHED)",
          "__f is None or not __f.corrected or (not __s.fresh)"),
         ("__ends = bool(__motion.stop_code) or __grips or __limp\n__ends |= __s.state.phase in LATCHED | TO_REST",
          "__ends = __grips or __limp"),
         room=CONTROL, tests=PLACE + "test_nothing_is_corrected_while_a_fault_is_latched"),
    _log("the way of a tick counts as lag", (
        "__wanted[__i] - __s.joints[__i].position_rad - min(max(__gone, min(__way, 0.0)), max(__way, 0.0))",
        "__wanted[__i] - __s.joints[__i].position_rad"),
        room=CONTROL,
        tests="tests/control/test_correction.py::"
        "test_a_joint_that_lifts_the_arm_at_speed_gets_the_whole_of_its_correction"),
    _log("a joint at its limit holds the tool", ("__v * (__to - __at) <= 0.0 != __v", "False"),
         room=CONTROL,
         tests="tests/host/test_motions.py::test_a_tool_is_led_on_by_the_others_where_a_joint_stands_at_its_limit"),
    _log("a model of another arm is used", (
        "(__model.arm_id, __model.calibration_hash) != (__arm.arm_id, __arm.calibration_hash)", "False"),
        room=CONTROL, tests=PLACE + "test_the_model_of_another_arm_is_refused"),
)
# fmt: on
