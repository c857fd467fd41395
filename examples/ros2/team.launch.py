"""A team of robots in one ROS graph: `ros2 launch ./team.launch.py robots:=r1,r2 config:=robot.toml`.

Each agent runs in its robot's namespace, with frames of its own (`r1/odom`, `r1/base_link`); all share `map`.
On robots with a computer each, launch one robot per computer: `robots:=r1`.
"""

from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from launch import LaunchContext, LaunchDescription


def agents(context: LaunchContext) -> list[ExecuteProcess]:
    """One `flocc agent` per robot."""
    said = {name: LaunchConfiguration(name).perform(context) for name in ("robots", "config", "use_sim_time")}
    return [agent(name, said["config"], said["use_sim_time"]) for name in said["robots"].split(",")]


def agent(name: str, config: str, use_sim_time: str) -> ExecuteProcess:
    """`flocc agent` of one robot; what is the same for all of them stands in the configuration."""
    own = ["--set", f'name="{name}"', "--set", f'folder="{name}"', "--set", f'ros2.namespace="/{name}"']
    frames = {"odom_frame": f"{name}/odom", "base_frame": f"{name}/base_link", "use_sim_time": use_sim_time}
    parameters = [word for key, value in frames.items() for word in ("-p", f"{key}:={value}")]
    return ExecuteProcess(
        cmd=["flocc", "agent", "--config", config, *own, "--ros-args", *parameters],
        name=f"flocc_{name}",
        output="screen",
        sigterm_timeout="20",
    )


def generate_launch_description() -> LaunchDescription:
    """What `ros2 launch` asks for."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("robots", default_value="r1,r2", description="Names, with commas between them."),
            DeclareLaunchArgument("config", default_value="robot.toml", description="Configuration of all agents."),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            OpaqueFunction(function=agents),
        ]
    )
