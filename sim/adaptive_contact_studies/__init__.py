"""Studies on the simulator: what the documents' figures are made with (extra ``studies``).

``paper`` repeats the paper's experiments, ``scenarios`` holds the learner to changes of the legs,
``quadruped_trials`` to a robot of other legs; ``training`` learns the shipped baselines, and
``headline``, ``speed`` and ``benchmark`` are what ``adaptive-contact bench`` measures.
"""
