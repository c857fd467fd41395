"""The run in one or two sentences."""

from flocc_launch.report.model import RunReport
from flocc_launch.runs.plain_numbers import number, seconds

COUNT_WORDS = {1: "one", 2: "two", 3: "three", 4: "four", 5: "five", 6: "six", 7: "seven", 8: "eight", 9: "nine"}


def verdict(report: RunReport) -> str:
    """Whether the maps merged, when, and what it did to the error."""
    if len(report.robots) == 1:
        return alone(report)
    parts = (
        misplaced_sentence(report),
        *report.doubted_places.values(),
        map_sentence(report),
        taken_back_sentence(report),
        error_sentence(report),
        camera_sentence(report),
    )
    return " ".join(sentence for sentence in parts if sentence)


def misplaced_sentence(report: RunReport) -> str:
    """Whose camera's axes are not those of its odometry, and whose place among others is so not to be believed."""
    frames = [robot.map_frame for robot in report.robot_details]
    among_others = [
        robot.robot
        for robot in report.robot_details
        if robot.robot in report.misplaced_cameras and robot.map_frame and frames.count(robot.map_frame) > 1
    ]
    verb = "is" if len(among_others) == 1 else "are"
    doubt = [f"Do not believe where {listed(among_others)} {verb}."] if among_others else []
    return " ".join([*report.misplaced_cameras.values(), *doubt])


def camera_sentence(report: RunReport) -> str:
    """Whose camera is not what its configuration says."""
    robots = [robot for robot in report.doubted_cameras if robot not in report.misplaced_cameras]
    if not robots:
        return ""
    whose = listed([f"{robot}'s" for robot in robots])
    if len(robots) == 1:
        return f"Look at {whose} camera: its pictures and odometry do not fit."
    return f"Look at {whose} cameras: their pictures and odometry do not fit."


def alone(report: RunReport) -> str:
    """What there is to say of a single robot, which closes loops with itself where it was asked to."""
    loops = report.closures.accepted
    if loops:
        return (
            f"One robot ran, alone, and closed {word(loops)} loop{'s' * (loops != 1)}. {error_sentence(report)}".strip()
        )
    error = "" if report.ate_joint_m is None else f" Its error is {number(report.ate_joint_m, 'm')} after alignment."
    return f"One robot ran, alone: nothing corrects its odometry.{error}"


def map_sentence(report: RunReport) -> str:
    """Whether the robots that lived to the end share one map."""
    died = [robot.robot for robot in report.robot_details if robot.end == "died"]
    living = [robot for robot in report.robot_details if robot.end != "died" and not robot.server]
    frames = {robot.map_frame for robot in living}
    who = f"{listed(died)} died; " if died else ""
    if not report.map_frames:
        return f"{who}no robot was ever corrected.".capitalize() if not who else f"{who}no robot was ever corrected."
    if len(living) > 1 and len(frames) == 1 and None not in frames:
        everyone = f"the other {word(len(living))} robots" if died else f"all {word(len(living))} robots"
        when = "" if report.merged_after_s is None else f" after {seconds(report.merged_after_s)}"
        return sentence(f"{who}{everyone} found one common map{when}.")
    apart = sum(frame is None for frame in (robot.map_frame for robot in living))
    maps = len(frames - {None})
    unplaced = f" and {word(apart)} without any" if apart else ""
    return sentence(
        f"{who}the robots did not merge: {word(maps)} separate map{'s' * (maps != 1)} at the end{unplaced}."
    )


def taken_back_sentence(report: RunReport) -> str:
    """That robots were in one map before, and no more."""
    spans = report.merges_taken_back
    if not spans:
        return ""
    last = f"from {seconds(spans[-1].from_s)} to {seconds(spans[-1].to_s)}"
    if len(spans) == 1:
        return f"They had been in one map {last}; that merge was taken back."
    return (
        f"They had been in one map {word(len(spans))} times before, last {last}; each of these merges was taken back."
    )


def error_sentence(report: RunReport) -> str:
    """What the joint error came to, against odometry alone."""
    before, after = report.ate_joint_odometry_m, report.ate_joint_m
    if before is None and not any(value is not None for value in report.ate_odometry_m.values()):
        return "There is no ground truth, so the error is not known."
    if after is None or before is None:
        return ""
    whose = " of the survivors" if any(robot.end == "died" for robot in report.robot_details) else ""
    aligned = report.ate_joint_odometry_aligned_m
    if after < before and aligned is not None and aligned <= after:
        return (
            f"The joint error{whose} is {number(after, 'm')}: less than odometry from its true starts "
            f"({number(before, 'm')}), but not less than that odometry aligned as the map is ({number(aligned, 'm')})."
        )
    if after < before:
        return f"The joint error{whose} fell from {number(before, 'm')} (odometry alone) to {number(after, 'm')}."
    return (
        f"The joint error{whose} is {number(after, 'm')}: not less than odometry put at the true starts "
        f"({number(before, 'm')}), which no robot knows."
    )


def sentence(text: str) -> str:
    """The text with its first letter as a sentence has it; names of robots stay as they are."""
    first = text.split(" ", 1)[0]
    return text if any(letter.isdigit() for letter in first) else text[:1].upper() + text[1:]


def word(count: int) -> str:
    """A small number in letters."""
    return COUNT_WORDS.get(count, str(count))


def listed(names: list[str]) -> str:
    """Names as in a sentence."""
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1]
