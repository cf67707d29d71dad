"""A belief over the obstacles from the sequence of their readings: the agent ``rise-belief``, see :mod:`.agent`."""
