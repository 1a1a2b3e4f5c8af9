#!/usr/bin/env python3
"""The reacher's law: joint states in, torques out."""

import contextlib
import math

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray

import lyapnet
from lyapnet.exchange.export import compiled

JOINTS = ("shoulder", "elbow")  # x: their positions, then their velocities


class PolicyNode(Node):
    """Publishes u(t, x) of the latest joint states at every Δt."""

    def __init__(self):
        super().__init__("policy_node")
        controller = lyapnet.load("zoo:reacher_limited", beyond="riccati")
        self.law, self.dt = compiled(controller), controller.horizon.dt
        self.x = self.first = self.latest = None
        self.stopped = False
        self.publisher = self.create_publisher(Float64MultiArray, "effort_controller/commands", 1)
        self.subscription = self.create_subscription(JointState, "joint_states", self.read, qos_profile_sensor_data)
        self.timer = self.create_timer(self.dt, self.step)

    def read(self, message):
        if self.stopped:
            return
        names = list(message.name)
        if not len(names) == len(message.position) == len(message.velocity):
            self.stop("a position and a velocity for each name are needed")
            return
        missing = [joint for joint in JOINTS if joint not in names]
        if missing:
            self.stop(f"there is no joint {missing[0]}")
            return
        at = [names.index(joint) for joint in JOINTS]
        self.x = [message.position[i] for i in at] + [message.velocity[i] for i in at]
        if not all(math.isfinite(x) for x in self.x):
            self.stop("the state is not finite")
            return
        self.latest = self.get_clock().now()
        self.first = self.first or self.latest

    def step(self):
        if self.first is None and not self.stopped:
            return  # no state yet
        now = self.get_clock().now()
        if not self.stopped and (now - self.latest).nanoseconds > 5 * self.dt * 1e9:
            self.stop("the state is too old")
        u = [0.0] * len(JOINTS)
        if not self.stopped:
            u = self.law.policy((now - self.first).nanoseconds / 1e9, self.x).tolist()
        self.publisher.publish(Float64MultiArray(data=u))

    def stop(self, reason):
        self.stopped = True
        self.get_logger().error(f"stopped, zeros from here on: {reason}")


def main():
    """Run the node until it is stopped."""
    rclpy.init()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(PolicyNode())


if __name__ == "__main__":
    main()
