"""This table holds what the paper states, each with its place; it is never copied from the code.

Whatever repeats a number of the paper is compared with this table (tests/benchmarks/test_paper_facts.py).
"""

# Sec. 3 ("We use sigma = ...") and Table 3; the Gaussian source is N(0, I).
SIGMA = {"gaussian": 1.0, "past": 0.5, "preview": 1.0}

# Sec. 4.1 and Table 3, of Robomimic and MimicGen alike.
EVALUATION = {"nfe": (1, 3, 9), "episodes": 200, "seeds": 3, "top_k": 3, "chunk": (8,)}
TRAINING = {
    # Architecture
    "hidden_dim": 384,
    "num_layers": 8,
    "num_heads": 6,
    "timestep_embedding_dim": 128,
    "dropout": 0.1,
    # Optimization
    "learning_rate": 1e-4,
    "weight_decay": 1e-5,
    "betas": (0.9, 0.999),
    "eps": 1e-8,
    "warmup_ratio": 0.20,
    "ema_rate": 0.995,
    "precision": "float32",
    # Policy and data
    "observation_steps": 2,
}
IMAGES = {"encoder": "resnet18-imagenet", "image_size": 84, "crop_size": 76}
TABLE_3 = {  # its first two columns
    "state": TRAINING | {"batch_size": 1024, "iterations": 200_000},
    "image": TRAINING | IMAGES | {"batch_size": 256, "iterations": 200_000},
    "mimicgen": TRAINING | IMAGES | {"batch_size": 128, "iterations": 50_000},
}
DEMONSTRATIONS = {"ph": 250, "mh": 300, "mimicgen": 10}
CAMERAS = {"mimicgen": 2, "square": 2, "tool_hang": 2, "transport": 4}
ACTION_DIM, STATE_DIM = (7, 14), (9, 53)

# Sec. 4.1.
MIMICGEN_TASKS = ("stack", "coffee", "threading")

# Table 1, percent: base, WP-Past and WP-Preview at NFE 9, then at 3, then at 1.
SUCCESS = {
    ("square", "ph", "state"): (86.7, 88.1, 88.1, 86.2, 88.0, 87.9, 83.6, 86.6, 87.3),
    ("square", "mh", "state"): (65.9, 69.2, 72.7, 65.4, 73.2, 72.9, 65.9, 70.1, 77.8),
    ("transport", "ph", "state"): (34.1, 36.2, 43.3, 39.0, 44.0, 49.1, 36.8, 39.8, 47.6),
    ("transport", "mh", "state"): (16.3, 20.7, 24.3, 21.3, 30.7, 30.4, 23.3, 30.2, 34.5),
    ("tool_hang", "ph", "state"): (79.4, 80.6, 82.8, 72.3, 75.1, 75.8, 77.7, 78.2, 81.9),
    ("square", "ph", "image"): (86.9, 88.2, 88.7, 87.7, 89.2, 89.6, 88.7, 89.3, 89.1),
    ("square", "mh", "image"): (76.1, 78.0, 77.8, 73.8, 77.9, 77.1, 72.4, 77.6, 75.1),
    ("transport", "ph", "image"): (92.8, 94.5, 94.3, 92.1, 93.9, 94.9, 91.3, 93.4, 93.7),
    ("transport", "mh", "image"): (74.8, 79.7, 79.8, 73.8, 80.0, 80.7, 74.3, 78.6, 79.7),
    ("tool_hang", "ph", "image"): (43.7, 45.8, 56.3, 36.9, 38.4, 50.7, 41.3, 38.9, 54.0),
    ("stack", "mimicgen", "image"): (21.4, 22.8, 31.6, 21.3, 23.7, 30.7, 21.3, 22.4, 28.7),
    ("coffee", "mimicgen", "image"): (26.8, 29.6, 34.7, 23.3, 24.1, 33.4, 16.2, 20.4, 29.4),
    ("threading", "mimicgen", "image"): (13.8, 15.5, 20.9, 16.3, 16.6, 22.0, 12.5, 15.6, 18.0),
}

# Table 2, relative to N(0, I): WP-Past, WP-Preview.
CURVATURE = {
    ("square", "ph"): (0.823, 0.803),
    ("square", "mh"): (0.705, 0.559),
    ("transport", "ph"): (0.720, 0.692),
    ("transport", "mh"): (0.695, 0.637),
    ("tool_hang", "ph"): (0.806, 0.807),
}
# Sec. 5.1, below Eq. 5.
CURVATURE_OBSERVATIONS, CURVATURE_STEPS = 2_000, 100

# Fig. 5: "a 1024-d 4-layer MLP", six demonstrations, two obstacles, panels e and f.
TOY = {"width": 1024, "layers": 4, "iterations": 50_000, "batch_size": 256, "sigma": (0.1, 0.5)}
TOY_DEMONSTRATIONS, TOY_OBSTACLES, TOY_OBSERVATION_DIM = 6, 2, 1

# Sec. 5.2, Fig. 6.
NO_CHUNKS = {"chunk": 1, "nfe": 1}

# Sec. 5.3, Fig. 7.
AGENTS = {"baselines": ("dsrl-na", "dsrl-sac"), "warm": ("dsrl-na",), "seeds": 3}
BOX_AROUND_MEAN, BOX_AROUND_ZERO = 0.5, 1.5

# The appendix on sigma: on Square-MH from the state.
SIGMAS = (1.5, 1.0, 0.5, 0.3, 0.1, 0.05, 0.0)
SIGMA_STUDY = {"nfe": (1,), "seeds": 3, "chunk": (8,)}
SIGMA_SUCCESS = {("past", 0.5): 0.701, ("past", 0.0): 0.05, ("preview", 1.0): 0.778, ("preview", 0.0): 0.31}

# What the public code that the paper may stand on does otherwise: "Much Ado About Noising" at commit 9f28318.
LOSS_FACTOR, CLIP_NORM = 0.1, 10.0
MUCH_ADO = {
    "warmup_ratio": 0.0,
    "max_grad_norm": CLIP_NORM / LOSS_FACTOR,
    "count_padding": True,
    "observation_layers": 2,
    "time_frequency": 1e-4,
    "temperature": [0.0],
}
MUCH_ADO_ACTIONS, MUCH_ADO_ENCODER = {"actions": "absolute"}, {"encoder": "resnet18"}
