"""What is asked of a scene, and what is done about it: loading, facts, plan, and the session that renders.

In the order of a render: :mod:`.load` reads a file, :mod:`.survey` finds shapes and boundaries, :mod:`.readings` looks at
values, :mod:`.needs` gathers the facts (:mod:`.needs`), :mod:`.plan` chooses (:mod:`.choices`, :mod:`.refusals`), :mod:`.plan`
makes the media and the estimators, and :mod:`.session` renders; :mod:`.explain` says all of it in words.
"""
