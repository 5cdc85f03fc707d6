"""A render from the question to the image: loading, facts, plan and the session that renders.

In the order of a render: :mod:`.load` reads a file, :mod:`.survey` finds shapes and boundaries, :mod:`.readings` reads values
of arrays, :mod:`.needs` gathers the facts, :mod:`.choices` and :mod:`.refusals` decide, :mod:`.plan` collects the decisions
and builds the media and estimators, and :mod:`.session` renders. :mod:`.explain` says all of this in words.
"""
