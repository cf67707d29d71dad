"""``python -m rise_envs.play``: drives an environment with the keyboard, by :mod:`rise_agents.play`.

That stands where demonstrations are, which it keeps; nothing else here knows of that package.
"""

import runpy

if __name__ == "__main__":
    runpy.run_module("rise_agents.play", run_name="__main__", alter_sys=True)
