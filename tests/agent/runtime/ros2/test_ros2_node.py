"""Which middleware is taken, and why; what is said where it cannot be; the launch file's commands."""

import importlib.util
import logging
import sys
import types
from pathlib import Path
from typing import Any

import pytest
from tests.agent.runtime.loopback import free_ports

from flocc_agent.config import AgentConfig, Ros2Config
from flocc_agent.runtime.ros2.node import middleware_fault, open_node
from flocc_agent.runtime.ros2.types import MessageTypes, Ros2Error, domain_of
from flocc_launch.commands.main import app, with_ros_args

ROOT = Path(__file__).parents[4]
NO_RCLPY = "no rclpy is here: source the robot's ROS first (setup.bash)"


@pytest.fixture
def no_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    monkeypatch.delenv("ROS_DOMAIN_ID", raising=False)
    monkeypatch.delitem(sys.modules, "flocc_agent.runtime.ros2.rclpy_node", raising=False)
    monkeypatch.setitem(sys.modules, "rclpy", None)


@pytest.mark.usefixtures("no_rclpy")
def test_without_rclpy_auto_takes_zenoh_and_says_why(caplog: pytest.LogCaptureFixture) -> None:
    (port,) = free_ports(1)
    with caplog.at_level(logging.INFO):
        open_node(Ros2Config(router=f"tcp/127.0.0.1:{port}"), "flocc_r1", (), MessageTypes()).close()
    assert f"ROS 2: rmw_zenoh by the agent's own zenoh, tcp/127.0.0.1:{port} ({NO_RCLPY})" in caplog.text


@pytest.mark.usefixtures("no_rclpy")
@pytest.mark.parametrize(
    ("middleware", "words", "said"),
    [
        ("rclpy", (), f"ros2.middleware is 'rclpy', but {NO_RCLPY}"),
        ("auto", ("-p", "map_frame:=world"), f"--ros-args needs rclpy, but {NO_RCLPY}"),
        ("rmw_zenoh", ("-p", "map_frame:=world"), "--ros-args needs rclpy, but ros2.middleware is rmw_zenoh"),
    ],
)
def test_what_only_rclpy_can_do_is_said(middleware: Any, words: tuple[str, ...], said: str) -> None:
    with pytest.raises(Ros2Error) as error:
        open_node(Ros2Config(middleware=middleware), "flocc_r1", words, MessageTypes())
    assert str(error.value) == said


def test_rclpy_of_another_python_is_said(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "rclpy").mkdir()
    (tmp_path / "rclpy" / "__init__.py").write_text("import rclpy._rclpy_pybind11\n")
    monkeypatch.delenv("RMW_IMPLEMENTATION", raising=False)
    monkeypatch.delitem(sys.modules, "flocc_agent.runtime.ros2.rclpy_node", raising=False)
    for name in [name for name in sys.modules if name.split(".")[0] == "rclpy"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Ros2Error, match=r"rclpy cannot be imported \(No module named 'rclpy._rclpy_pybind11'\); is it"):
        open_node(Ros2Config(middleware="rclpy"), "flocc_r1", (), MessageTypes())


def test_a_middleware_that_is_not_there_is_said_before_it_ends_the_process(tmp_path: Path) -> None:
    (tmp_path / "librmw_fastrtps_cpp.so").touch()
    there = {"LD_LIBRARY_PATH": f"/none:{tmp_path}"}
    assert middleware_fault({**there, "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}) is None
    assert middleware_fault(there) is None
    assert middleware_fault({**there, "RMW_IMPLEMENTATION": "rmw_zenoh_cpp"}) == (
        "RMW_IMPLEMENTATION is rmw_zenoh_cpp, and no folder of LD_LIBRARY_PATH has it; install or unset it"
    )


@pytest.mark.parametrize(("given", "domain_id"), [({}, 0), ({"ROS_DOMAIN_ID": ""}, 0), ({"ROS_DOMAIN_ID": "42"}, 42)])
def test_the_domain_is_that_of_the_environment(given: dict[str, str], domain_id: int) -> None:
    assert domain_of(given) == domain_id


@pytest.mark.parametrize("given", ["233", "-1", "x", "1.0"])
def test_a_domain_that_cannot_be_is_said(given: str) -> None:
    with pytest.raises(Ros2Error, match=r"must be a number from 0 to 232"):
        domain_of({"ROS_DOMAIN_ID": given})


def test_all_words_behind_ros_args_go_to_ros() -> None:
    words = ["agent", "--config", "r.toml", "--ros-args", "-p", "a:=1", "--params-file", "p.yaml", "--", "--verbose"]
    assert with_ros_args(words) == [
        "agent", "--config", "r.toml", "--verbose",
        "--ros-args=-p", "--ros-args=a:=1", "--ros-args=--params-file", "--ros-args=p.yaml",
    ]  # fmt: skip
    assert with_ros_args(["agent", "--config", "r.toml"]) == ["agent", "--config", "r.toml"]


class Kept:
    """Stands for a class of `launch`: keeps what it was made of."""

    def __init__(self, *given: Any, **named: Any) -> None:
        self.given, self.named = given, named


def test_each_command_of_the_launch_file_is_one_that_flocc_takes(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    names = ("LaunchContext", "LaunchDescription", "DeclareLaunchArgument", "ExecuteProcess", "OpaqueFunction")
    for module in ("launch", "launch.actions", "launch.substitutions"):
        stand_in: Any = types.ModuleType(module)
        for name in (*names, "LaunchConfiguration"):
            setattr(stand_in, name, Kept)
        monkeypatch.setitem(sys.modules, module, stand_in)
    spec = importlib.util.spec_from_file_location("team_launch", ROOT / "examples/ros2/team.launch.py")
    assert spec is not None
    assert spec.loader is not None
    team = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(team)
    config = tmp_path / "robot.toml"
    config.write_text('name = "robot"\n[ros2]\nimage_topic = "camera/image_raw"\n')
    words = team.agent("r2", str(config), "true").named["cmd"]
    assert words[:2] == ["flocc", "agent"]
    import typer.main

    command: Any = typer.main.get_command(app)
    given = command.commands["agent"].make_context("agent", with_ros_args(words[2:])).params
    read = AgentConfig.read(config, given["changes"])
    assert read.ros2 is not None
    assert (read.name, read.ros2.namespace) == ("r2", "/r2")
    assert given["ros_args"] == [
        "-p", "odom_frame:=r2/odom", "-p", "base_frame:=r2/base_link", "-p", "use_sim_time:=true",
    ]  # fmt: skip


def test_the_files_for_rviz_and_nav2_name_topics_that_an_agent_publishes() -> None:
    from ruamel.yaml import YAML

    rviz = YAML(typ="safe").load((ROOT / "examples/ros2/swarm.rviz").read_text())
    shown = {display["Topic"]["Value"] for display in rviz["Visualization Manager"]["Displays"] if "Topic" in display}
    topics = {"flocc/graph", "flocc/path", "flocc/pose", "flocc_r1/merged_map"}
    published = {f"/{robot}/{topic}" for robot in ("r1", "r2") for topic in topics}
    assert shown <= published
    assert {topic.split("/", 2)[2] for topic in shown} == topics
    nav2 = YAML(typ="safe").load((ROOT / "examples/ros2/nav2_team.yaml").read_text())["/r1"]
    static = nav2["global_costmap"]["global_costmap"]["ros__parameters"]["static_layer"]
    assert static["map_topic"] in published
    assert nav2["local_mapper"]["ros__parameters"]["global_frame"] == "r1/odom"
