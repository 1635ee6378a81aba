"""Published results of the problems, each with its source."""

CHAMPNEYS = "Champneys et al., 2024"
BEINTEMA = "Beintema, Tóth and Schoukens, 2021"
WORDEN = "Worden et al., 2018"
RELAN = "Relan et al., 2017"
BRUNOT = "Brunot, Janot and Carrillo, 2017"
KERNELS = "Dalla Libera, Carli and Pillonetto, 2021"
VOLTERRA = "Birpoutsoukis, Csurcsia and Schoukens, 2018"
NOEL = "Noël et al., 2017"
SCHOUKENS = "Schoukens, 2021"
IACOB = "Iacob et al., 2025"
PADUART = "Paduart et al., 2010"
MANIFOLD = "Forgione and Piga, 2025"

RESULTS: dict[str, list[tuple[str, dict[str, float], str]]] = {
    "tanks": [
        ("grey box with overflow", {"test": 0.191}, f"{WORDEN}, in {CHAMPNEYS}"),
        ("nonlinear state space", {"test": 0.343}, RELAN),
        ("physics with overflow", {"test": 0.376}, BRUNOT),
        ("GRU", {"test": 0.396}, CHAMPNEYS),
        ("polynomial NARX", {"test": 0.413}, CHAMPNEYS),
        ("Volterra, by kernels", {"test": 0.48}, KERNELS),
        ("Volterra, regularised", {"test": 0.54}, VOLTERRA),
        ("linear state space", {"test": 0.588}, CHAMPNEYS),
        ("GP-NARX", {"test": 0.622}, CHAMPNEYS),
    ],
    "silverbox": [
        ("polynomial state space", {"arrow": 0.26}, PADUART),
        (
            "GP-NARX",
            {"multisine": 0.301, "arrow": 0.60, "inside": 0.259},
            CHAMPNEYS,
        ),
        (
            "SUBNET",
            {"multisine": 0.36, "arrow": 1.4, "inside": 0.32},
            f"{BEINTEMA}, in {CHAMPNEYS}",
        ),
        (
            "polynomial NARX",
            {"multisine": 0.640, "arrow": 2.25, "inside": 0.571},
            CHAMPNEYS,
        ),
        ("GRU", {"multisine": 1.49, "arrow": 2.80, "inside": 0.947}, CHAMPNEYS),
        (
            "linear state space",
            {"multisine": 6.96, "arrow": 14.4, "inside": 6.58},
            CHAMPNEYS,
        ),
    ],
    "bouc_wen": [
        ("neural state space", {"multisine": 7.16}, SCHOUKENS),
        ("neural state space", {"multisine": 7.87}, MANIFOLD),
        ("polynomial state space", {"multisine": 12.1}, NOEL),
        ("Koopman", {"multisine": 14.3}, IACOB),
        ("physics, structure known", {"multisine": 46.8, "sweep": 1.86}, BRUNOT),
    ],
}

SOURCES = {
    CHAMPNEYS: "Baseline results for selected nonlinear system identification "
    "benchmarks, arXiv 2405.10779. Our table takes the errors from a "
    "transcription of this paper.",
    BEINTEMA: "Nonlinear state-space identification using deep encoder networks, L4DC.",
    PADUART: "Identification of nonlinear systems using polynomial nonlinear state "
    "space models, Automatica 46. We quote the errors from later papers. The "
    "models of this paper were fitted to other samples than our models.",
    WORDEN: "we quote the errors from the paper of Champneys et al., 2024.",
    RELAN: "An unstructured flexible nonlinear model for the cascaded water-tanks "
    "benchmark, IFAC-PapersOnLine 50-1.",
    BRUNOT: "Continuous-time nonlinear systems identification with output error method "
    "based on derivative-free optimisation, IFAC-PapersOnLine 50-1. The paper "
    "gives the errors in percent, and we converted them to the units of our tables.",
    KERNELS: "Kernel-based methods for Volterra series identification, Automatica 129.",
    VOLTERRA: "Efficient multidimensional regularization for Volterra series "
    "estimation, Mechanical Systems and Signal Processing 104.",
    NOEL: "A nonlinear state-space approach to hysteresis identification, Mechanical "
    "Systems and Signal Processing 84. The multisine of the test in this paper is "
    "not the same as our multisine.",
    SCHOUKENS: "Improved initialization of state-space artificial neural networks, "
    "ECC. Later papers quote errors between 7.16 and 7.53 for this model.",
    IACOB: "Koopman identification with a deep encoder.",
    MANIFOLD: "Manifold meta-learning for reduced-complexity neural system "
    "identification.",
}
