"""Both ends of the wire: the node and the player as processes, and an observer in the test."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseArray, PoseWithCovarianceStamped, TransformStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_srvs.srv import Trigger

__all__ = ["Observer", "Process", "node", "observing", "player"]

Value = TypeVar("Value")

HERE = Path(__file__).parent
# Long enough for the slowest machine that compiles every kernel anew.
PATIENCE = 120.0
TRANSITIONS = {
    "configure": Transition.TRANSITION_CONFIGURE,
    "activate": Transition.TRANSITION_ACTIVATE,
    "deactivate": Transition.TRANSITION_DEACTIVATE,
    "cleanup": Transition.TRANSITION_CLEANUP,
    "shutdown": Transition.TRANSITION_UNCONFIGURED_SHUTDOWN,
}


class Process:
    """A process with a log, killed at the latest when the test ends."""

    def __init__(self, words: list[str], log: Path, **environment: str) -> None:
        self.log = log
        self._stream = log.open("ab")
        self.process = subprocess.Popen(
            words,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._stream,
            env={**os.environ, **environment},
            text=True,
        )

    def tell(self, **task: Any) -> Any:
        """Let a player do something; wait until it is done."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(task) + "\n")
        self.process.stdin.flush()
        return self.answer()

    def answer(self) -> Any:
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def kill(self) -> None:
        """End it without a chance to say good-bye."""
        self.process.kill()
        self.process.wait()

    def end(self, seconds: float = 20.0) -> int:
        """Ask it to end, as a terminal does; give its exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(seconds)

    def close(self) -> None:
        with suppress(ProcessLookupError):
            self.process.kill()
        self.process.wait()
        for stream in (self.process.stdin, self.process.stdout, self._stream):
            if stream is not None:
                with suppress(BrokenPipeError):
                    stream.close()


class Observer:
    """Hears all that the node says, and calls its services."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("observer")
        self.heard: dict[str, list[Any]] = {
            name: [] for name in ("initialpose", "hypotheses", "pose", "diagnostics", "tf")
        }
        self._subscribe(PoseArray, "/anchorscan/hypotheses", "hypotheses")
        self._subscribe(PoseWithCovarianceStamped, "/anchorscan/pose", "pose")
        self._subscribe(DiagnosticArray, "/diagnostics", "diagnostics")
        self._subscribe(TransformStamped, "/stand_in_for_tf", "tf")
        self._clients: dict[str, Any] = {}
        self._parameters: Any = None
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def listen(self) -> None:
        """Begin to listen to the pose, as AMCL does when it is active."""
        self._subscribe(PoseWithCovarianceStamped, "/initialpose", "initialpose")

    def _subscribe(self, kind: Any, topic: str, name: str) -> None:
        self.node.create_subscription(kind, topic, self.heard[name].append, 50)

    def _spin(self) -> None:
        with suppress(ExternalShutdownException):
            self._executor.spin()

    def close(self) -> None:
        self._executor.shutdown()
        self._thread.join()
        self.node.destroy_node()

    def wait(self, what: Callable[[], Value], reason: str, seconds: float = PATIENCE) -> Value:
        """Wait until something is true."""
        end = time.monotonic() + seconds
        while not (value := what()):
            if time.monotonic() > end:
                told = f"{self.summary()}; {self.values()}"
                raise AssertionError(f"{reason} in {seconds} s; diagnostics: {told}")
            time.sleep(0.02)
        return value

    def next_of(self, name: str, seconds: float = PATIENCE) -> Any:
        """Wait for a message that has not come yet."""
        count = len(self.heard[name])
        return self.wait(lambda: self.heard[name][count:], f"no {name}", seconds)[0]

    def summary(self) -> str:
        """Return what diagnostics said last."""
        arrays = self.heard["diagnostics"]
        return arrays[-1].status[0].message if arrays else ""

    def values(self) -> dict[str, str]:
        """Return the values that diagnostics named last."""
        arrays = self.heard["diagnostics"]
        return {each.key: each.value for each in arrays[-1].status[0].values} if arrays else {}

    def says(self, words: str) -> None:
        """Wait until diagnostics say something."""
        self.wait(lambda: words in self.summary(), f"nothing about {words!r}")

    def call(self, kind: Any, name: str, request: Any, seconds: float = PATIENCE) -> Any:
        # Kept: what is destroyed while the executor spins can take the process with it.
        client = self._clients.get(name)
        if client is None:
            client = self.node.create_client(kind, f"/anchorscan/{name}")
            self._clients[name] = client
        assert client.wait_for_service(seconds), f"there is no service {name}"
        # What was killed is believed to live for a while, and to it requests go astray; but a
        # transition that is asked for twice fails.
        for patience in (seconds,) if kind is ChangeState else (5.0, 5.0, seconds):
            future = client.call_async(request)
            with suppress(AssertionError):
                self.wait(future.done, "", patience)
                return future.result()
        raise AssertionError(f"no answer of {name}")

    def change(self, transition: str) -> bool:
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[transition]
        return bool(self.call(ChangeState, "change_state", request).success)

    def state(self) -> str:
        return str(self.call(GetState, "get_state", GetState.Request()).current_state.label)

    def trigger(self, service: str) -> tuple[bool, str]:
        answer = self.call(Trigger, service, Trigger.Request())
        return bool(answer.success), str(answer.message)

    def set_parameter(self, name: str, value: Any) -> None:
        if self._parameters is None:
            self._parameters = AsyncParameterClient(self.node, "/anchorscan")
        assert self._parameters.wait_for_services(PATIENCE)
        future = self._parameters.set_parameters([Parameter(name, value=value)])
        self.wait(future.done, "no answer about parameters")
        assert future.result().results[0].successful, future.result()


@contextmanager
def observing() -> Iterator[Observer]:
    """Open this end of the wire; ROS is initialized."""
    observer = Observer()
    try:
        yield observer
    finally:
        observer.close()


def node(
    folder: Path, *words: str, command: bool = False, tf2: bool = False, **parameters: Any
) -> Process:
    """Start the node with parameters, by the command line or with tf2 if wanted."""
    start = [str(Path(sys.executable).with_name("anchorscan")), "ros"]
    if not command:
        start = [sys.executable, "-m", "anchorscan.ros_node"]
    given = {"diagnostics_period": 0.1, **parameters}
    told = [
        word for name, value in given.items() for word in ("-p", f"{name}:={json.dumps(value)}")
    ]
    path = os.environ.get("PYTHONPATH", "")
    if tf2:
        path = os.pathsep.join([str(HERE / "stand_ins"), path])
    return Process([*start, "--ros-args", *told, *words], folder / "node.log", PYTHONPATH=path)


def player(folder: Path) -> Process:
    """Start a player."""
    process = Process([sys.executable, str(HERE / "player.py")], folder / "player.log")
    assert process.answer() == "player.py"
    return process
