"""The robot three times side by side, and the page that shows it."""

import socket
import time
from collections.abc import Iterator
from http.client import HTTPConnection, HTTPResponse
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import pytest
from mujoco.studio import messages
from rich.console import Console
from scipy.spatial.transform import Rotation
from websockets.exceptions import InvalidStatus
from websockets.sync.client import ClientConnection, connect

import elastic_env  # noqa: F401  registers the environments
from elastic_env.core.errors import ConfigurationError, SystemFailedError
from elastic_env.rendering.side_by_side import (
    COPIES,
    LINK,
    MOTOR,
    REFERENCE,
    SideBySide,
    enlarged_pose,
)
from tests.three_joints import ARM
from train.commands.view import Page, Playback, View, record, show
from train.commands.view_proxy import Access, Head, RefusedError, open_listener
from train.evaluate.conditions import Condition, PolicySpec


@pytest.fixture(scope="module")
def walker() -> Any:
    """The walker after a few steps without compensation, bent."""
    env: Any = gymnasium.make("elastic_env/WalkInPlace-v0", step_period=3.0, num_steps=2)
    env.reset(seed=0)
    for _ in range(5):
        *_, env.info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    yield env
    env.close()


def posed(picture: Any, now: Any, factor: float) -> tuple[SideBySide, mujoco.MjData]:
    """The three robots in their postures."""
    scene = SideBySide(picture.display_robot())
    data = mujoco.MjData(scene.model)
    scene.pose(data, picture.sides(now), factor)
    mujoco.mj_kinematics(scene.model, data)
    return scene, data


def test_the_link_side_at_factor_one_is_the_robot_of_the_physics(walker: Any) -> None:
    """Catches joints in another order, and a base that is elsewhere: MuJoCo's own bodies say
    where the robot is."""
    scene, data = posed(walker.unwrapped.picture, walker.info, 1.0)
    simulation = walker.unwrapped.simulation
    truth = mujoco.MjData(simulation.model)
    truth.qpos[:] = simulation.qpos[0]
    mujoco.mj_kinematics(simulation.model, truth)
    offset = scene.model.body(f"{LINK}pelvis").pos - scene.model.body(f"{MOTOR}pelvis").pos
    for foot in ("l_foot", "r_foot", "pelvis"):
        np.testing.assert_allclose(
            data.body(LINK + foot).xpos - offset, truth.body(foot).xpos, atol=2e-9
        )
        np.testing.assert_allclose(data.body(LINK + foot).xmat, truth.body(foot).xmat, atol=2e-9)


def test_the_motor_side_is_what_the_encoders_say(walker: Any) -> None:
    """Catches motor and link exchanged: the deflection is what lies between them."""
    scene, data = posed(walker.unwrapped.picture, walker.info, 1.0)
    del scene
    truth = walker.unwrapped.truth()
    for number, name in enumerate(walker.unwrapped.picture.display_robot().joints):
        deflection = data.joint(MOTOR + name).qpos - data.joint(LINK + name).qpos
        np.testing.assert_allclose(
            deflection, truth.theta[0, number] - truth.q[0, number], atol=1e-12
        )


def test_deviations_grow_with_the_factor_and_the_reference_stays(walker: Any) -> None:
    """Catches a factor that also moves the reference, or that is applied twice."""
    picture = walker.unwrapped.picture
    at = {factor: posed(picture, walker.info, factor)[1] for factor in (0.0, 1.0, 4.0)}
    for name in picture.display_robot().joints:
        reference = at[1.0].joint(REFERENCE + name).qpos
        for copy in COPIES:
            np.testing.assert_allclose(at[0.0].joint(copy + name).qpos, reference)
            once, four = (at[f].joint(copy + name).qpos - reference for f in (1.0, 4.0))
            np.testing.assert_allclose(four, 4.0 * once, atol=1e-12)


def test_a_pose_is_enlarged_about_the_planned_one() -> None:
    """Catches an angle that is enlarged about another axis; SciPy's rotation vectors are the
    reference."""
    planned = Rotation.from_rotvec([0.1, -0.2, 0.3])
    turn = np.array([0.02, 0.01, -0.03])
    true = planned * Rotation.from_rotvec(turn)
    poses = [
        np.array([*position, *rotation.as_quat(scalar_first=True)])
        for position, rotation in (((0, 0, 1), planned), ((0.1, 0, 1.2), true))
    ]
    found = enlarged_pose(poses[0], poses[1], 3.0)
    np.testing.assert_allclose(found[:3], [0.3, 0.0, 1.6])
    expected = planned * Rotation.from_rotvec(3.0 * turn)
    np.testing.assert_allclose(
        Rotation.from_quat(found[3:], scalar_first=True).as_matrix(), expected.as_matrix()
    )


@pytest.fixture(scope="module")
def page() -> Iterator[Page]:
    """A page that shows the testbed, with its loop in a thread."""
    condition = Condition(
        env="testbed", policy=PolicySpec(name="input"), scenario="ideal", reference="sine"
    )
    recording = record(condition, Console(quiet=True), max_s=0.2)
    np.testing.assert_allclose(recording.times_s, np.arange(0.004, 0.2, 0.02))
    playback = Playback(recording, paused=True)
    playback.tick()
    assert (playback.time_s, recording.at(0.0), recording.at(1e9)) == (
        0.0,
        recording.frames[0],
        recording.frames[-1],
    )
    with show(recording) as shown:
        for _ in range(3):
            shown.handle.sync()
        yield shown


def ask(page: Page, path: str, method: str = "GET", **headers: str) -> HTTPResponse:
    """Send a request without a token of its own."""
    connection = HTTPConnection("127.0.0.1", page.access.port, timeout=20.0)
    names = {name.replace("_", "-"): value for name, value in headers.items()}
    connection.request(method, path, headers=names)
    return connection.getresponse()


def token(page: Page) -> str:
    """The token, as the printed address has it."""
    return page.access.address.rpartition("=")[2]


def cookie(page: Page) -> str:
    """The cookie of a browser that has opened the printed address."""
    with ask(page, f"/?token={token(page)}") as answer:
        given = answer.headers["Set-Cookie"]
    assert "HttpOnly" in given
    assert "SameSite=Strict" in given
    return given.partition(";")[0]


def open_socket(page: Page, path: str, **arguments: Any) -> ClientConnection:
    """Open a WebSocket of the page."""
    address = f"ws://127.0.0.1:{page.access.port}{path}"
    headers = {"Cookie": cookie(page)}
    return connect(address, **{"additional_headers": headers, "open_timeout": 20.0, **arguments})


def test_the_page_serves_the_three_robots(page: Page) -> None:
    """Catches a viewer that does not start, a page without its model, and a cookie that does not
    open the rest."""
    assert [page.handle.model.joint(number).name for number in range(3)] == [
        f"{copy}link" for copy in COPIES
    ]
    with ask(page, f"/?token={token(page)}") as answer:
        assert answer.status == 200
        assert b"<canvas" in answer.read()
        assert "Access-Control-Allow-Origin" not in answer.headers
        assert answer.headers["Cross-Origin-Opener-Policy"] == "same-origin"
    end = time.monotonic() + 20.0
    model = b""
    while (
        b"link" not in model and time.monotonic() < end
    ):  # its thread takes the model a little later
        page.handle.sync()
        with ask(page, "/model", Cookie=cookie(page)) as answer:
            model = answer.read()
    assert all(f"{copy}link".encode() in model for copy in COPIES)


def test_the_page_draws_by_its_sockets(page: Page) -> None:
    """Catches a proxy that answers pages and holds up WebSockets, with the Origin that a browser
    sends."""
    with open_socket(page, "/state?sid=1", origin=f"http://127.0.0.1:{page.access.port}") as state:
        assert "viewers=1" in str(state.recv(timeout=20.0))
        page.handle.sync()
        heard = [state.recv(timeout=20.0) for _ in range(3)]
        assert any(isinstance(one, bytes) for one in heard)


FOREIGN: list[dict[str, str]] = [
    {"Host": "evil.example"},
    {"Host": "evil.example:{port}"},
    {"Host": "127.0.0.1:1"},
    {"Host": "127.0.0.1"},
    {"Host": "127.0.0.1.evil.example:{port}"},
    {"Host": "localhost:{port}@evil.example"},
    {"Host": ""},
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://127.0.0.1:1"},
    {"Origin": "https://127.0.0.1:{port}"},
    {"Origin": "http://localhost:{port}"},
    {"Origin": "http://127.0.0.1:{port}.evil.example"},
]


@pytest.mark.parametrize("headers", FOREIGN, ids=str)
def test_requests_of_others_are_refused(page: Page, headers: dict[str, str]) -> None:
    """Catches DNS rebinding, and a hostile page whose requests bring the browser's cookie along."""
    given = {name: value.format(port=page.access.port) for name, value in headers.items()}
    for path in ("/", "/model", "/state", f"/?token={token(page)}"):
        with ask(page, path, Cookie=cookie(page), **given) as answer:
            assert answer.status == 403, path
    with pytest.raises(InvalidStatus) as refused:
        open_socket(page, "/state", additional_headers={"Cookie": cookie(page), **given})
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    "path", ["/", "/?token=", "/?token=wrong", "/model", "/web_client.js", "/ui", "/state"]
)
def test_requests_without_the_token_are_refused(page: Page, path: str) -> None:
    """Catches a door that only the first page has, and a token that is compared by its
    beginning."""
    for kept in ({}, {"Cookie": f"{page.access.cookie}=wrong"}, {"Cookie": f"{cookie(page)}x"}):
        with ask(page, path, **kept) as answer:
            assert answer.status == 403
    with pytest.raises(InvalidStatus):
        open_socket(page, path, additional_headers={})


@pytest.mark.parametrize(
    "path", ["/drop", "/drop?sid=1", "/drop/", "/DROP", "//drop", "/%64rop", "/state/../drop"]
)
def test_uploads_are_refused(page: Page, path: str) -> None:
    """Catches a model that is dropped on the page: MuJoCo reads any file that it names."""
    if path.startswith("/drop"):
        with ask(page, path, Cookie=cookie(page)) as answer:
            assert answer.status == 403
    with pytest.raises(InvalidStatus) as refused:
        open_socket(page, path)
    assert refused.value.response.status_code == 403
    with ask(page, "/", "POST", Cookie=cookie(page)) as answer:
        assert answer.status == 403


def test_what_follows_a_request_is_not_passed_on(page: Page) -> None:
    """Catches a second request behind one that was let in, which the viewer would answer."""
    host = f"Host: 127.0.0.1:{page.access.port}\r\nCookie: {cookie(page)}\r\n"
    upload = f"GET /drop HTTP/1.1\r\n{host}Upgrade: websocket\r\nConnection: Upgrade\r\n\r\n"
    for line in ("", "Content-Length: 5\r\n", "Transfer-Encoding: chunked\r\n"):
        with socket.create_connection(("127.0.0.1", page.access.port), timeout=20.0) as browser:
            browser.sendall(f"GET /favicon.ico HTTP/1.1\r\n{host}{line}\r\n{upload}".encode())
            answers = b"".join(iter(lambda: browser.recv(65536), b""))
        assert answers.count(b"HTTP/1.1 ") == 1
        assert answers.startswith(b"HTTP/1.1 403" if line else b"HTTP/1.1 200")


def test_only_this_machine_reaches_the_page(page: Page) -> None:
    """Catches a viewer that listens on every address beside the proxy; /proc says who listens."""
    files = [link for link in Path("/proc/self/fd").iterdir() if link.is_symlink()]
    sockets = {str(link.readlink()) for link in files if link.is_symlink()}
    for table, loopback in (("tcp", "0100007F"), ("tcp6", "00000000000000000000000001000000")):
        rows = [row.split() for row in Path(f"/proc/net/{table}").read_text().splitlines()[1:]]
        listening = {row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in sockets}
        assert {address.partition(":")[0] for address in listening} <= {loopback}


def test_another_model_does_not_end_the_page(page: Page, tmp_path: Path) -> None:
    """Catches a page that takes a model without our joints, and ends as a defect of this
    program."""
    file = tmp_path / "other.xml"
    file.write_text(
        "<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>"
    )
    page.handle.dispatch(messages.LoadModelEvent(path=str(file)))
    assert page.handle.model.nbody > 2
    page.handle.sync(
        mujoco.MjModel.from_xml_path(str(file)),
        mujoco.MjData(mujoco.MjModel.from_xml_path(str(file))),
    )


def test_a_page_that_cannot_listen_says_so() -> None:
    """Catches a traceback for a port that is taken, or a host that is none."""
    with open_listener() as taken, pytest.raises(SystemFailedError, match="name another --port"):
        open_listener(port=taken.getsockname()[1])
    for host in ("no.such.host.invalid", "a" * 300):
        with pytest.raises(ConfigurationError, match="--host must be an address"):
            open_listener(host)
    for port in (-1, 65536):
        with pytest.raises(ConfigurationError, match=r"port must be .* >= 0 and <= 65535, got"):
            View(port=port)


@pytest.mark.parametrize(
    ("host", "own", "foreign"),
    [
        ("127.0.0.1", ["localhost:80", "127.0.0.1", "[::1]:80"], ["10.0.0.1", "x.example"]),
        ("10.0.0.7", ["10.0.0.7", "10.0.0.7:80"], ["localhost", "10.0.0.8", "x.example"]),
        ("0.0.0.0", ["10.0.0.7", "[fe80::1]:80", "localhost"], ["x.example", "10.0.0.7.x.example"]),
    ],
)
def test_a_page_knows_its_hosts(host: str, own: list[str], foreign: list[str]) -> None:
    """Catches a page on a network that any name may stand for, or that its own address does not
    open."""
    access = Access(host, 80)
    for name in own:
        request = Head(
            f"GET /?token={access.token} HTTP/1.1", [("Host", name), ("Origin", f"http://{name}")]
        )
        assert access.admit(request).path == "/"
    for name in foreign:
        with pytest.raises(RefusedError):
            access.admit(Head(f"GET /?token={access.token} HTTP/1.1", [("Host", name)]))


def test_a_robot_of_ones_own_has_sides() -> None:
    """Catches a picture without them: a JointRobot needs no code of its own."""
    env: Any = ARM.robot.make(reference="sine")
    env.reset(seed=0)
    *_, info = env.step(np.zeros(env.action_space.shape, dtype=np.float32))
    scene, data = posed(env.unwrapped.picture, info, 1.0)
    del scene
    truth = env.unwrapped.truth()
    found = [
        data.joint(LINK + name).qpos[0] for name in env.unwrapped.picture.display_robot().joints
    ]
    np.testing.assert_allclose(found, truth.q[0])
    env.close()
