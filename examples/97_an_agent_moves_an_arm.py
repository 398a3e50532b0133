"""An agent moves an arm by tools of MCP: what a language model would do, written as a program."""

import asyncio
import os
import sys
import tempfile
from pathlib import Path

from mcp.client.session import ClientSession
from mcp.client.stdio import StdioServerParameters, stdio_client

WALL = '<mujoco><worldbody><body name="wall" pos="0.45 0 0.2"><geom type="box" size=".02 .2 .2"/></body></worldbody></mujoco>'
CALLS = (
    ("move_to", {"position": [0.3, 0.3, 0.3]}),
    ("move_l", {"position": [0.3, 0.2, 0.2], "speed": 0.5}),
    ("move_to", {"position": [0.45, 0.1, 0.2]}),  # inside the wall
    ("move_to", {"position": [0.3, 0.2]}),
    ("move_j", {"q": {"shoulder_yaw": 200}}),
    ("undo", {}),
)


async def main() -> None:
    """Starts a server, as the program of a language model does, and calls its tools."""
    scene = Path(tempfile.mkdtemp()) / "wall.xml"
    scene.write_text(WALL)
    command = ["-m", "armctl", "mcp", "robot_arm_3dof", "--scene", str(scene)]
    server = StdioServerParameters(command=sys.executable, args=command, env=dict(os.environ))
    async with stdio_client(server) as (read, write), ClientSession(read, write) as session:
        await session.initialize()
        tools = (await session.list_tools()).tools
        print("tools:", ", ".join(tool.name for tool in tools))
        for name, arguments in CALLS:
            answer = await session.call_tool(name, arguments)
            print(f"{name}: {answer.content[0].text}")


asyncio.run(main())
