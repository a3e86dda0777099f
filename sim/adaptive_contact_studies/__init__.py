"""Studies on the simulator: what the documents' figures are made with (extra ``studies``).

``paper`` repeats the paper's experiments, ``scenarios`` holds the learner to changes of the legs,
``family`` learns what is known of any leg; ``training`` learns the shipped baselines, and
``headline``, ``speed`` and ``benchmark`` are what ``adaptive-contact bench`` measures.
"""
