"""Where one may look for it: ``python -m rise_agents.play`` drives, as it keeps demonstrations, which are of there."""

if __name__ == "__main__":
    raise SystemExit(
        "rise_envs.play: to drive with the keyboard: python -m rise_agents.play RISE-GroundVehicle-v0"
    )
