"""What a user waits for: the programs that `python -m benchmarks.compilation` times.

Each case is a function that imports and prepares all that the wait is not about, and
returns what is waited for. It runs in a process of its own.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np


Thunk = Callable[[], Any]


@dataclass(frozen=True)
class Case:
    """Something to wait for.

    - `prepare`: gives what is waited for, and if there is, what comes after it: the
      same for other shapes.
    - `limit`: seconds that the wait may last, if there is a limit.
    - `peer`: the case that does the same without delucax.
    - `at_most`: how many times the peer's wait it may last.
    """

    prepare: Callable[[], tuple[Thunk, ...]]
    limit: float | None = None
    peer: str | None = None
    at_most: float | None = None


CASES: dict[str, Case] = {}


def case(name: str, limit: float | None = None, **options: Any) -> Callable[..., Any]:
    """Register a function as a case."""

    def register(prepare: Callable[[], Any]) -> Callable[[], Any]:
        CASES[name] = Case(prepare, limit, **options)
        return prepare

    return register


def system(n: int) -> tuple[np.ndarray, ...]:
    """A random unstable system with a quarter as many controls as states, and weights;
    in discrete time."""
    rng = np.random.default_rng(n)
    m = max(1, n // 4)
    A = 1.2 * rng.normal(size=(n, n)) / np.sqrt(n)
    return A, rng.normal(size=(n, m)), np.eye(n), np.eye(m)


def of_shapes(solve: Callable[..., Any]) -> tuple[Thunk, ...]:
    """Four states first, then further shapes."""
    data = [system(n) for n in (4, 2, 10, 30, 50)]
    return tuple(lambda given=given: solve(*given) for given in data)


@case("dare", 0.5, peer="SciPy: dare")
def dare():
    import delucax as dlx

    return of_shapes(dlx.riccati.dare)


@case("care", 0.5, peer="SciPy: care")
def care():
    import delucax as dlx

    return of_shapes(dlx.riccati.care)


@case("SciPy: dare")
def scipy_dare():
    import scipy.linalg

    return of_shapes(scipy.linalg.solve_discrete_are)


@case("SciPy: care")
def scipy_care():
    import scipy.linalg

    return of_shapes(scipy.linalg.solve_continuous_are)


@case("dlyap", 0.5)
def dlyap():
    import delucax as dlx

    return of_shapes(lambda A, B, Q, R: dlx.riccati.dlyap(0.5 * A, Q))


@case("lyap", 0.5)
def lyap():
    import delucax as dlx

    solve = dlx.riccati.lyap
    return of_shapes(lambda A, B, Q, R: solve(A - 2 * np.eye(len(A)), Q))


@case("hinf_dare", 0.5)
def hinf_dare():
    import delucax as dlx

    return of_shapes(
        lambda A, B, Q, R: dlx.riccati.hinf_dare(A, B, 0.1 * np.eye(len(A)), Q, R)
    )


@case("hinf_care", 0.5)
def hinf_care():
    import delucax as dlx

    return of_shapes(
        lambda A, B, Q, R: dlx.riccati.hinf_care(A, B, 0.1 * np.eye(len(A)), Q, R)
    )


@case("dre, 50 steps", 0.5)
def dre():
    import delucax as dlx

    return of_shapes(lambda *given: dlx.riccati.dre(*given, horizon=50))


def linear(A: np.ndarray, B: np.ndarray, C: Any = None) -> Any:
    """A discrete-time model."""
    import delucax as dlx

    return dlx.LinearDynamics(A, B, C, dt=0.1)


@case("LQR of matrices", 0.5)
def lqr():
    # The package itself is a part of the import, which is timed apart.
    from delucax.controllers import LQR

    return of_shapes(lambda A, B, Q, R: LQR(linear(A, B), Q, R))


@case("LQG of matrices", 0.5)
def lqg():
    from delucax.controllers import LQG

    def design(A, B, Q, R):
        C = np.eye(len(A))[: len(R)]
        return LQG(linear(A, B, C), Q, R, Q, R)

    return of_shapes(design)


@case("HInfinity of matrices", 0.5)
def hinfinity():
    from delucax.controllers import HInfinity

    return of_shapes(lambda A, B, Q, R: HInfinity(linear(A, B), Q, R))


def stable(A: np.ndarray, B: np.ndarray) -> Any:
    """A stable model in continuous time, with as many outputs as controls."""
    import delucax as dlx

    eye, abscissa = np.eye(len(A)), np.max(np.linalg.eigvals(A).real)
    return dlx.systems.LinearSystem(A - (abscissa + 0.5) * eye, B, eye[: B.shape[1]])


@case("margins", 0.5)
def margins():
    from delucax.analysis import margins

    return of_shapes(lambda A, B, Q, R: margins(stable(A, B[:, :1])))


@case("disk_margin", 0.5)
def disk_margin():
    from delucax.analysis import disk_margin

    return of_shapes(lambda A, B, Q, R: disk_margin(stable(A, B)))


@case("hinf_norm", 0.5)
def hinf_norm():
    from delucax.analysis import hinf_norm

    return of_shapes(lambda A, B, Q, R: hinf_norm(stable(A, B)))


@case("c2d and d2c", 0.5)
def conversions():
    from delucax import c2d, d2c

    return of_shapes(lambda A, B, Q, R: d2c(c2d(stable(A, B), 0.1)))


@case("python-control: dlqr")
def control_lqr():
    import control

    return of_shapes(lambda A, B, Q, R: control.dlqr(A, B, Q, R))


def upright(design: Callable[..., Any]) -> Callable[[], tuple[Thunk, ...]]:
    """`make`, `linearize` and a design about the upright pendulum."""

    def prepare():
        import delucax as dlx

        def answer():
            env = dlx.make("pendulum")
            return design(dlx.controllers, dlx.linearize(env.dynamics))

        return (answer,)

    return prepare


case("LQR of the pendulum", 1.5)(
    upright(lambda c, plant: c.LQR(plant, np.eye(2), np.eye(1)))
)
case("LQG of the pendulum", 1.5)(
    upright(
        lambda c, plant: c.LQG(
            plant, np.eye(2), np.eye(1), 0.01 * np.eye(2), 0.01 * np.eye(2)
        )
    )
)
case("HInfinity of the pendulum", 1.5)(
    upright(lambda c, plant: c.HInfinity(plant, np.eye(2), np.eye(1)))
)


@case("make and linearize a quadrotor", 1.5)
def hover():
    import delucax as dlx

    return (lambda: dlx.linearize(dlx.make("quadrotor").dynamics).A,)


@case("make every task", 3.0)
def every_task():
    import jax

    import delucax as dlx

    key = jax.random.key(0)
    drawn = dict.fromkeys(("lds", "neural"), dict(key=key))
    names = [name for name in dlx.environments.registered() if "/" not in name]
    return (lambda: [dlx.make(name, **drawn.get(name, {})) for name in names],)


def compiled(solve: str, gradient: bool) -> Callable[[], tuple[Thunk, ...]]:
    """A Riccati equation of four states under `jit`, at the user's arrays."""

    def prepare():
        import jax
        import jax.numpy as jnp

        import delucax as dlx

        def number(*given):
            solution = getattr(dlx.riccati, solve)(*given, throw=False)
            return jnp.sum(solution.X) + jnp.sum(solution.K)

        def solution(*given):
            return getattr(dlx.riccati, solve)(*given, throw=False)

        program = jax.grad(number, argnums=(0, 1, 2, 3)) if gradient else solution
        data = tuple(jnp.asarray(M) for M in system(4))
        run = jax.jit(program)
        return (lambda: run(*data),)

    return prepare


case("jit of dare", 1.0)(compiled("dare", False))
case("jit of dare, gradient", 1.5)(compiled("dare", True))
case("jit of care", 1.5)(compiled("care", False))
case("jit of care, gradient", 2.25)(compiled("care", True))


def rollout(name: str) -> Callable[[], tuple[Thunk, ...]]:
    """A task without control."""

    def prepare():
        import jax

        import delucax as dlx

        env = dlx.make(name)
        zero, key = dlx.controllers.Zero(env.control_size), jax.random.key(0)
        return (lambda: dlx.rollout(env, zero, key=key, throw=False),)

    return prepare


case("rollout", 0.8)(rollout("pendulum"))
for _task in ("quadrotor", "dynamic_bicycle", "balloon_lung"):
    case(f"rollout of {_task}", 0.8)(rollout(_task))


def simulate(adaptive: bool) -> Callable[[], tuple[Thunk, ...]]:
    """A pendulum under held controls for 100 intervals."""

    def prepare():
        import diffrax
        import jax.numpy as jnp

        import delucax as dlx

        system, controls = dlx.systems.Pendulum(), jnp.zeros((100, 1))
        x0, ts = jnp.array([1.0, 0.0]), jnp.linspace(0.0, 5.0, 101)
        steps = diffrax.PIDController(rtol=1e-6, atol=1e-9) if adaptive else None
        options = dict(dt=0.05, ts=ts, stepsize_controller=steps)
        # Its module is imported at first use, and imports are another figure.
        simulate = dlx.simulate
        run = lambda: simulate(system, controls, 0.0, 5.0, x0, **options)
        return (lambda: run().states,)

    return prepare


def diffeqsolve(adaptive: bool) -> Callable[[], tuple[Thunk, ...]]:
    """The same by Diffrax alone."""

    def prepare():
        import diffrax
        import jax.numpy as jnp

        x0, ts = jnp.array([1.0, 0.0]), jnp.linspace(0.0, 5.0, 101)
        controls = jnp.zeros((100, 1))
        steps = diffrax.StepTo(ts)
        if adaptive:
            steps = diffrax.PIDController(rtol=1e-6, atol=1e-9, jump_ts=ts)

        def field(t, x, controls):
            k = jnp.clip((t / 0.05).astype(int), 0, 99)
            torque = controls[k, 0]
            return jnp.stack([x[1], 15.0 * jnp.sin(x[0]) + 3.0 * torque])

        def answer():
            return diffrax.diffeqsolve(
                diffrax.ODETerm(field),
                diffrax.Tsit5(),
                0.0,
                5.0,
                None,
                x0,
                controls,
                saveat=diffrax.SaveAt(ts=ts),
                stepsize_controller=steps,
            ).ys

        return (answer,)

    return prepare


for _kind, _adaptive in (("fixed steps", False), ("adaptive steps", True)):
    _peer = f"Diffrax: diffeqsolve, {_kind}"
    case(f"simulate, {_kind}", peer=_peer, at_most=1.3)(simulate(_adaptive))
    case(_peer)(diffeqsolve(_adaptive))


def quadrotor(constrained: bool, start: Any) -> Callable[[], tuple[Thunk, ...]]:
    """A plan of 50 steps of the planar quadrotor, from controls or from where
    delucax finds that they should be."""

    def prepare():
        import jax.numpy as jnp

        import delucax as dlx

        env = dlx.make("planar_quadrotor")
        x0 = jnp.array([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])
        low = lambda t, x, u: 0.2 - x[1] - 0.3 * x[0]
        constraints = dlx.planning.Constraints(low) if constrained else None
        given = env.dynamics, env.cost, x0, start
        return (lambda: dlx.planning.ilqr(*given, constraints=constraints),)

    return prepare


_zero = np.zeros((50, 2))
case("ilqr of the quadrotor", 2.0)(quadrotor(False, _zero))
case("ilqr of the quadrotor, a state constraint", 3.0)(quadrotor(True, _zero))
case("ilqr of the quadrotor, the default start")(quadrotor(False, 50))


@case("MPC, first step", 2.0)
def mpc():
    import jax.numpy as jnp

    import delucax as dlx

    env = dlx.make("cartpole")
    mpc = dlx.controllers.MPC(env.dynamics, env.cost, 20, bounds=(-10.0, 10.0))
    x0 = jnp.array([0.1, 0.1, 0.0, 0.0])
    return (lambda: mpc(jnp.asarray(0.0), x0, mpc.init()),)


def sampled(planner: str) -> Callable[[], tuple[Thunk, ...]]:
    """A plan of 50 steps of the pendulum by sampling."""

    def prepare():
        import jax
        import jax.numpy as jnp

        import delucax as dlx

        env, key = dlx.make("pendulum"), jax.random.key(0)
        plan = getattr(dlx.planning, planner)()
        given = env.dynamics, env.cost, jnp.array([0.5, 0.0]), jnp.zeros((50, 1))
        return (lambda: plan(*given, bounds=(-2.0, 2.0), key=key),)

    return prepare


case("MPPI")(sampled("MPPI"))
case("CEM")(sampled("CEM"))


def repeated(learn: str) -> Callable[[], tuple[Thunk, ...]]:
    """Runs of a quadrotor in wind, of which the model does not know."""

    def prepare():
        import jax.numpy as jnp

        import delucax as dlx

        env = dlx.make("planar_quadrotor")
        plant = dlx.make("planar_quadrotor", wind="dissipative", wind_strength=0.4)
        hover = jnp.tile(env.dynamics.equilibrium()[1], (50, 1))
        plan = dlx.planning.ilqr(env.dynamics, env.cost, env.initial_state, hover)
        given = plant.dynamics, env.dynamics, env.cost, plan
        return (lambda: getattr(dlx.planning, learn)(*given, iterations=10),)

    return prepare


case("ilc")(repeated("ilc"))
case("igpc")(repeated("igpc"))


def online(learner: str) -> Callable[[], tuple[Thunk, ...]]:
    """The design of a learner for a double integrator, and an episode of it."""

    def prepare():
        import jax

        import delucax as dlx

        A, B = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.0], [1.0]])
        plant = dlx.LinearDynamics(A, B)
        cost = dlx.costs.Quadratic(np.eye(2), np.eye(1))
        push = dlx.disturbances.Constant(np.ones(2))
        env, key = dlx.Environment(plant, cost, disturbance=push), jax.random.key(0)
        design = getattr(dlx.controllers, learner)

        def answer():
            return dlx.rollout(env, design(plant, cost), key=key, horizon=99)

        return (answer,)

    return prepare


for _learner in ("gpc", "drc", "sfc"):
    case(f"{_learner} and an episode")(online(_learner))


@case("fit, ten steps", peer="Optax by hand, ten steps", at_most=1.3)
def fit():
    import jax
    import optax

    import delucax as dlx

    env, key = dlx.make("pendulum", horizon=50), jax.random.key(0)
    policy = dlx.controllers.MLP(3, 1, 32, 2, features=env.encode, key=key)
    loss = dlx.training.expected_cost(env, batch=32)
    run = lambda: dlx.training.fit(
        loss, policy, optax.adam(1e-3), 10, key=key, progress=False
    )
    return (run,)


@case("Optax by hand, ten steps")
def by_hand():
    import equinox as eqx
    import jax
    import jax.numpy as jnp
    import optax

    key = jax.random.key(0)
    network = eqx.nn.MLP(3, 1, 32, 2, jnp.tanh, key=key)
    optimiser = optax.adam(1e-3)

    def loss(network, key):
        def total(key):
            low, high = jnp.array([-jnp.pi, -1.0]), jnp.array([jnp.pi, 1.0])
            x0 = jax.random.uniform(key, (2,), minval=low, maxval=high)

            def step(x, _):
                theta, speed = x
                u = network(jnp.stack([jnp.cos(theta), jnp.sin(theta), speed]))[0]
                u = jnp.clip(u, -2.0, 2.0)
                angle = (theta + jnp.pi) % (2 * jnp.pi) - jnp.pi
                cost = angle**2 + 0.1 * speed**2 + 0.001 * u**2
                speed = speed + 0.05 * (15.0 * jnp.sin(theta) + 3.0 * u)
                speed = jnp.clip(speed, -8.0, 8.0)
                return jnp.stack([theta + 0.05 * speed, speed]), cost

            return jnp.sum(jax.lax.scan(step, x0, None, 50)[1])

        return jnp.mean(jax.vmap(total)(jax.random.split(key, 32)))

    @eqx.filter_jit
    def update(network, state, key):
        value, slope = eqx.filter_value_and_grad(loss)(network, key)
        updates, state = optimiser.update(slope, state)
        return eqx.apply_updates(network, updates), state, value

    def answer():
        model, at = network, optimiser.init(eqx.filter(network, eqx.is_array))
        value = None
        for k in range(10):
            model, at, value = update(model, at, jax.random.fold_in(key, k))
        return value

    return (answer,)


def bounded_lq(gradient: bool) -> Callable[[], tuple[Thunk, ...]]:
    """128 linear-quadratic problems with bounded controls; Frey et al., 2025."""

    def prepare():
        import jax
        import jax.numpy as jnp

        import delucax as dlx

        rng = np.random.RandomState(42)
        A, B = np.eye(8) + 0.2 * rng.randn(8, 8), rng.randn(8, 4)
        b, starts = rng.randn(8), rng.randn(128, 8)

        class Weighted(dlx.AbstractCost):
            H: Any = dlx.parameter()

            def __call__(self, t, x, u):
                z = jnp.concatenate([x, u])
                return z @ self.H @ z

            def final(self, t, x):
                return x @ self.H[:8, :8] @ x

        def plan(A, B, b, H, x0):
            dynamics = dlx.LinearDynamics(A, B, dt=1.0, x_next=b)
            return dlx.planning.ilqr(
                dynamics, Weighted(H), x0, jnp.zeros((20, 4)), bounds=(-1.0, 1.0)
            )

        def first_controls(*data):
            one = lambda x0: jnp.sum(plan(*data, x0).controls[0])
            return jnp.sum(jax.vmap(one)(starts))

        def plans(*data):
            return jax.vmap(lambda x0: plan(*data, x0).controls)(starts)

        data = tuple(jnp.asarray(M) for M in (A, B, b, np.eye(12)))
        run = jax.jit(jax.grad(first_controls, (0, 1, 2, 3)) if gradient else plans)
        return (lambda: run(*data),)

    return prepare


case("128 bounded LQ problems", 2.0)(bounded_lq(False))
case("128 bounded LQ problems, adjoint", 4.0)(bounded_lq(True))


@case("steering in least time", 5.0)
def steering():
    """The particle of COPS: a push of constant size, at an angle to choose, takes it to
    a height of 5 and a velocity of (45, 0) in least time, which is 0.554577.

    Time runs from 0 to 1. The final time is a state, which the first step sets by a
    control of its own; later, where that control does nothing, its square is charged,
    so that the minimum is a strict one. The angle alone is bounded. What is missed at
    the end is in tens, so that the weights of the constraints fit the cost.
    """
    import jax.numpy as jnp

    import delucax as dlx

    steps = 50

    class Steering(dlx.AbstractDynamics):
        disturbance_size = 0

        @property
        def state_names(self):
            return "x", "y", "vx", "vy", "final time"

        @property
        def control_names(self):
            return "angle", "change of the final time"

        @property
        def dt(self):
            return jnp.asarray(1.0 / steps)

        def advance(self, t, x, u, w):
            angle, changes = u[0], t < 0.5 / steps
            x = x.at[4].add(jnp.where(changes, u[1], 0.0))
            h, p, v = x[4] * self.dt, x[:2], x[2:4]
            push = 100.0 * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
            # Exact, because the push is constant within a step.
            p, v = p + h * v + h**2 / 2 * push, v + h * push
            return jnp.concatenate([p, v, x[4:]]), dlx.RESULTS.successful

    constraints = dlx.planning.Constraints(
        final_equality=lambda t, x: (x[1:4] - jnp.array([5.0, 45.0, 0.0])) / 10.0,
    )
    unused = lambda t, x, u: jnp.where(t < 0.5 / steps, 0.0, u[1] ** 2)
    cost = dlx.costs.Function(unused, lambda t, x: x[4])
    x0 = jnp.array([0.0, 0.0, 0.0, 0.0, 0.6])
    start = jnp.zeros((steps, 2)).at[:, 0].set(jnp.linspace(1.0, -1.0, steps))
    high = jnp.array([jnp.pi / 2, jnp.inf])
    bounds = -high, high
    given = Steering(), cost, x0, start, 0.0, None, bounds
    return (lambda: dlx.planning.ilqr(*given, constraints=constraints).states,)


@case("python -m delucax --help", 0.3)
def command_line():
    import subprocess
    import sys

    command = [sys.executable, "-m", "delucax", "--help"]
    return (lambda: subprocess.run(command, capture_output=True, check=True),)


@case("gym.make and a step", 1.0)
def gym():
    import gymnasium
    import numpy as np

    import delucax.interop.gymnasium  # noqa: F401

    def answer():
        env = gymnasium.make("delucax/Pendulum-v1")
        env.reset(seed=0)
        return env.step(np.zeros(1, np.float32))

    return (answer,)
