"""The key contract: every tensor that two parts of the library exchange, and its name.

Shapes use ``B`` (any batch dimensions), ``To`` (observation steps), ``P`` (prediction length),
``H`` (chunk length), ``d_o`` and ``d_a`` (observation and action width). Time runs from ``t=0``
(source) to ``t=1`` (data). Index 0 of a chunk is the action at the *current* step. All actions under
these keys live in the normalised action space; :data:`ACTION` alone is raw on the simulator's side
of the denormalising transform.

======================  =====================================  ==================================
constant                key                                    shape and dtype
======================  =====================================  ==================================
:data:`OBSERVATION`     ``"observation"``                      ``[*B, To, d_o]`` float
:data:`STATE`           ``"state"``, nested under observation  ``[*B, To, d_s]`` float
:data:`FEATURES`        ``"features"``, of an encoder           ``[*B, To, d_o]`` float
:data:`CONDITIONED`     ``("prior", "observation")``           ``[*B, To, d_o + n * d_a + 1]`` float
:data:`ACTION`          ``"action"``                           ``[*B, d_a]`` float
:data:`EEF_POSE`        ``"eef_pose"``                         ``[*B, arms, 3, 4]`` float, raw
:data:`SIM_STATE`       ``"sim_state"``                        ``[*B, 1 + nq + nv]`` float64, raw
:data:`ACTIONS`         ``("history", "actions")``             ``[*B, H, d_a]`` float
:data:`STEPS`           ``("history", "steps")``               ``[*B, 1]`` int64
:data:`FORECAST`        ``("history", "forecast")``            ``[*B, P, d_a]`` float
:data:`FORECAST_STEPS`  ``("history", "forecast_steps")``      ``[*B, 1]`` int64
:data:`LOC`             ``("prior", "loc")``                   ``[*B, P, d_a]`` float
:data:`WARM`            ``("prior", "warm")``                  ``[*B, P, 1]`` bool
:data:`ANCHOR`          ``("prior", "anchor")``                ``[*B, P, d_a]`` float
:data:`NOISE`           ``("prior", "noise")``, the source a0  ``[*B, P, d_a]`` float
:data:`DELTA`           ``("prior", "delta")``                 ``[*B, P, d_a]`` float
:data:`CHUNK`           ``("vla_action", "chunk")``            ``[*B, P, d_a]`` float
:data:`DECODED_NOISE`   ``("decoded", "noise")``               ``[*B, P, d_a]`` float
:data:`DECODED_CHUNK`   ``("decoded", "chunk")``               ``[*B, P, d_a]`` float
:data:`DELAY`           ``("rtc", "delay")``                   ``[*B, 1]`` int64
:data:`IS_PAD`          ``"action_is_pad"``                    ``[*B, P]`` bool
:data:`EXECUTED`        ``"executed_steps"``                   ``[*B, 1]`` int64
:data:`SUCCESS`         ``"success"``                          ``[*B, 1]`` bool
:data:`EPISODE`         ``"episode"``                          ``[N]`` int64, data only
:data:`FRAME`           ``"frame"``                            ``[N]`` int64, data only
======================  =====================================  ==================================

An observation with images has several entries, nested under :data:`OBSERVATION`: the vector
:data:`STATE`, and images uint8 ``[*B, To, 3, h, w]`` under robomimic's names, such as
``"agentview_image"``.

:data:`HISTORY` is what the robot did and planned to do (:mod:`warmprior.history`). Data, environments and
robots write it; the policy writes :data:`LOC`, :data:`WARM` and :data:`NOISE`. :data:`DELAY` is the
number of control steps during which the last chunk is still executed while the next one is computed; 0
without a last chunk.

In prior-space reinforcement learning :data:`ANCHOR` is the centre of the agent's box and :data:`DELTA` its
action, so that the source is always ``noise = anchor + delta``. An environment that decodes by itself writes
what it decoded under ``("next", "decoded", "noise")`` and ``("next", "decoded", "chunk")``;
without ``"next"`` they are those of the step before.

:data:`EEF_POSE` holds the grippers' rotations and, in the last column, positions in metres, both in the
world. Environments write it if policies act by absolute poses. They write :data:`SIM_STATE`, the time,
positions and velocities of the simulator, if policies see images, which are rendered from it.
"""

from __future__ import annotations

from torchrl.data.vla import ACTION_CHUNK_KEY, ACTION_IS_PAD_KEY, ACTION_KEY, OBSERVATION_KEY

OBSERVATION = OBSERVATION_KEY
STATE = "state"
ACTION = ACTION_KEY
EEF_POSE = "eef_pose"
SIM_STATE = "sim_state"
FEATURES = "features"
CONDITIONED = ("prior", "observation")
HISTORY = "history"
ACTIONS = ("history", "actions")
STEPS = ("history", "steps")
FORECAST = ("history", "forecast")
FORECAST_STEPS = ("history", "forecast_steps")
SOURCE = "prior"
LOC = ("prior", "loc")
WARM = ("prior", "warm")
ANCHOR = ("prior", "anchor")
NOISE = ("prior", "noise")
DELTA = ("prior", "delta")
CHUNK = ACTION_CHUNK_KEY
DECODED_NOISE = ("decoded", "noise")
DECODED_CHUNK = ("decoded", "chunk")
DELAY = ("rtc", "delay")
IS_PAD = ACTION_IS_PAD_KEY
EXECUTED = "executed_steps"
EPISODE = "episode"
FRAME = "frame"
SUCCESS = "success"
