"""A simulated UR controller, to which the real ur-rtde libraries connect: python rtde_stand_in.py ADDRESS.

It speaks RTDE protocol 2 (port 30004), the dashboard (29999) and takes scripts (30001 to 30003). Of the script that
ur-rtde uploads it runs nothing: it plays what the script does with the registers for moveL, stopL and setTcp (the
numbers of the commands were read from the script that ur-rtde 1.6.5 uploads). The arm is a point that moves on straight
lines. On its standard input it takes lines "name value", for example "protective 1", and prints its state as JSON.
It is a process of its own, because ur-rtde holds Python's lock while it connects.
"""

import contextlib
import json
import socket
import struct
import sys
import threading
import time

MOVEL, SET_TCP, STOPL, STOP_SCRIPT, MOVEL_FK = 3, 29, 33, 255, 4
VECTORS6 = {
    "target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q", "actual_qd", "actual_qdd",
    "actual_current", "joint_control_output", "actual_TCP_pose", "actual_TCP_speed", "actual_TCP_force",
    "target_TCP_pose", "target_TCP_speed", "joint_temperatures", "actual_joint_voltage", "ft_raw_wrench",
    "payload_inertia", "actual_current_as_torque",
}  # fmt: skip
CODES = {
    "DOUBLE": ">d", "UINT32": ">I", "INT32": ">i", "UINT64": ">Q", "UINT8": ">B", "VECTOR6D": ">6d", "VECTOR3D": ">3d",
    "VECTOR6INT32": ">6i",
}  # fmt: skip


def kind(name: str) -> str:
    if name in VECTORS6 or name == "external_force_torque":
        return "VECTOR6D"
    if name in ("actual_tool_accelerometer", "payload_cog", "elbow_position", "elbow_velocity"):
        return "VECTOR3D"
    if name == "joint_mode":
        return "VECTOR6INT32"
    if name in ("actual_digital_input_bits", "actual_digital_output_bits"):
        return "UINT64"
    if "_int_register_" in name or name in ("robot_mode", "safety_mode", "safety_status"):
        return "INT32"
    if "bits" in name or "bit_registers" in name or name in ("runtime_state", "speed_slider_mask"):
        return "UINT32"
    return "DOUBLE"


class Arm:
    """The state, moved on by `tick`."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.pose = [0.3, 0.2, 0.4, 0.0, 3.0, 0.5]
        self.tcp = [0.0] * 6
        self.target, self.speed, self.moving = list(self.pose), 0.1, False
        self.running, self.command, self.inputs = False, 0, {}
        self.moves: list[list[float]] = []
        self.protective = self.emergency = self.silent = self.short = self.script_fails = self.off = 0
        self.connections: list[socket.socket] = []
        self.start = time.monotonic()

    def tick(self, dt: float) -> None:
        with self.lock:
            if self.protective or self.emergency:
                self.moving = self.running = False
            if not self.moving:
                return
            gap = [b - a for a, b in zip(self.pose[:3], self.target[:3], strict=True)]
            far = sum(g * g for g in gap) ** 0.5
            if far <= self.speed * dt:
                self.pose[:3], self.moving = self.target[:3], False
            else:
                self.pose[:3] = [a + g / far * self.speed * dt for a, g in zip(self.pose, gap, strict=False)]

    def ordered(self, values: dict[str, float]) -> None:
        """What the uploaded script does when the registers change."""
        with self.lock:
            self.inputs.update(values)
            command = self.inputs.get("input_int_register_0", 0)
            if command == self.command:
                return
            self.command = command
            numbers = [self.inputs.get(f"input_double_register_{i}", 0.0) for i in range(8)]
            if command == MOVEL and not self.script_fails:
                self.moves.append([*numbers, self.inputs.get("input_int_register_1", 0)])
                self.target, self.speed, self.moving = numbers[:6], numbers[6], True
                if self.short:
                    self.target = [a + 0.5 * (b - a) for a, b in zip(self.pose, self.target, strict=True)]
            elif command == SET_TCP:
                self.tcp = numbers[:6]
            elif command == STOPL:
                self.moving = False
            elif command == STOP_SCRIPT:
                self.running = self.moving = False

    def outputs(self) -> dict[str, object]:
        with self.lock:
            safety = 1 | (4 if self.protective else 0) | (128 if self.emergency else 0)
            speed = self.speed if self.moving else 0.0
            return {
                "timestamp": time.monotonic() - self.start,
                "actual_TCP_pose": self.pose,
                "actual_TCP_speed": [speed, 0, 0, 0, 0, 0],
                "robot_mode": 5 if self.off else 7,
                "safety_mode": 1,
                "robot_status_bits": 1 | (2 if self.running else 0),
                "safety_status_bits": safety,
                "runtime_state": 2 if self.running else 1,
                # 1: ready for a command; 2: done with it. An asynchronous move is done once it has begun.
                "output_int_register_0": 2 if self.command else 1,
            }


def listen(port: int, talk: object) -> None:
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    server.bind((sys.argv[1], port))
    server.listen()

    def loop() -> None:
        while True:
            connection, _ = server.accept()
            threading.Thread(target=quietly, args=(talk, connection), daemon=True).start()

    threading.Thread(target=loop, daemon=True).start()


def quietly(talk: object, connection: socket.socket) -> None:
    with connection:
        try:
            talk(connection)
        except OSError:
            return


def rtde(arm: Arm, connection: socket.socket) -> None:
    arm.connections.append(connection)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sending, recipes = threading.Lock(), []
    started = threading.Event()

    def send(command: int, body: bytes) -> None:
        with sending:
            connection.sendall(struct.pack(">HB", 3 + len(body), command) + body)

    buffer = b""
    while data := connection.recv(65536):
        buffer += data
        while len(buffer) >= 3 and len(buffer) >= (size := struct.unpack(">H", buffer[:2])[0]):
            command, body, buffer = chr(buffer[2]), buffer[3:size], buffer[size:]
            if command == "V":
                send(ord("V"), b"\x01")
            elif command == "v":
                send(ord("v"), struct.pack(">IIII", 5, 11, 0, 0))
            elif command == "I":
                recipes.append([name for name in body.decode().split(",") if name])
                send(ord("I"), bytes([len(recipes)]) + ",".join(map(kind, recipes[-1])).encode())
            elif command == "O":
                hertz, names = struct.unpack(">d", body[:8])[0], [n for n in body[8:].decode().split(",") if n]
                send(ord("O"), b"\x01" + ",".join(map(kind, names)).encode())
                threading.Thread(
                    target=stream, args=(arm, send, names, min(hertz, 125.0), started), daemon=True
                ).start()
            elif command in "SP":
                send(ord(command), b"\x01")
                (started.set if command == "S" else started.clear)()
            elif command == "U":
                values, at = {}, 1
                for name in recipes[body[0] - 1]:
                    code = CODES[kind(name)]
                    values[name] = struct.unpack_from(code, body, at)[0]
                    at += struct.calcsize(code)
                arm.ordered(values)


def stream(arm: Arm, send: object, names: list[str], hertz: float, started: threading.Event) -> None:
    try:
        while True:
            time.sleep(1 / hertz)
            if not started.is_set() or arm.silent:
                continue
            values, body = arm.outputs(), b"\x01"
            for name in names:
                code = CODES[kind(name)]
                value = values.get(name, [0] * int(code[1]) if code[1].isdigit() else 0)
                body += struct.pack(code, *value) if isinstance(value, list) else struct.pack(code, value)
            send(ord("U"), body)
    except OSError:
        return


def dashboard(connection: socket.socket) -> None:
    connection.sendall(b"Connected: Universal Robots Dashboard Server\n")
    answers = {
        b"PolyscopeVersion": b"URSoftware 5.11.0.108249",
        b"get serial number": b"20225500001",
        b"stop": b"Stopped",
    }
    for line in connection.makefile("rb"):
        connection.sendall(answers.get(line.strip(), b"true") + b"\n")


def scripts(arm: Arm, connection: socket.socket) -> None:
    text = b""
    while data := connection.recv(65536):
        text += data
        if b"def rtde_control" in text and text.rstrip().endswith(b"end"):
            text = b""
            with arm.lock:
                arm.running, arm.command = True, 0


def main() -> None:
    arm = Arm()
    listen(29999, dashboard)
    for port in (30001, 30002, 30003):
        listen(port, lambda connection: scripts(arm, connection))
    listen(30004, lambda connection: rtde(arm, connection))

    def run() -> None:
        while True:
            time.sleep(0.004)
            arm.tick(0.004)

    threading.Thread(target=run, daemon=True).start()
    print("ready", flush=True)
    for line in sys.stdin:
        name, _, value = line.strip().partition(" ")
        if name == "hang_up":
            while arm.connections:
                with contextlib.suppress(OSError):  # it may have been closed by the other side
                    arm.connections.pop().shutdown(socket.SHUT_RDWR)
        elif name != "state":
            setattr(arm, name, json.loads(value))
        state = {"pose": arm.pose, "tcp": arm.tcp, "moves": arm.moves, "running": arm.running, "moving": arm.moving}
        print(json.dumps(state), flush=True)


if __name__ == "__main__":
    main()
