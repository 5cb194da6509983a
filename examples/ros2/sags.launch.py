"""A node, the overlay and the bridge to ROS 2, by `ros2 launch`; when one ends, all do.

    ros2 launch examples/ros2/sags.launch.py launch:=mine.yaml scene:=vessels.yaml

`sags` must be on the PATH, from an environment of its own. Checked against a stub of `launch` alone.
"""

from launch.actions import DeclareLaunchArgument, ExecuteProcess, Shutdown
from launch.conditions import IfCondition, UnlessCondition
from launch.substitutions import LaunchConfiguration, PythonExpression

from launch import LaunchDescription


def generate_launch_description() -> LaunchDescription:
    scene = LaunchConfiguration("scene")
    none = PythonExpression(["not '", scene, "'"])
    programs = [
        (["run", LaunchConfiguration("launch")], None),
        (["overlay"], IfCondition(none)),
        (["overlay", "--scene", scene], UnlessCondition(none)),
        (["bridge", "ros2"], None),
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("launch", description="a launch file of sags, or a recording"),
            DeclareLaunchArgument("scene", default_value="", description="of the overlay; '': a target"),
            *(
                ExecuteProcess(cmd=["sags", *words], output="screen", condition=when, on_exit=Shutdown())
                for words, when in programs
            ),
        ]
    )
