"""Speed of fitting inverse-gp's three GPs: ours, GPyTorch, scikit-learn and LAPACK's own time, same data, same process.

    python benchmarks/gp_fit.py [--runs 5] [--quick] [-o benchmarks/results/gp_fit.md]

Data: the simulated bar6 rig, random positions, 0.2 px noise, standardised: d = 4, 8, 12 inputs for 2, 4, 6 cameras.
GPyTorch: ARD RBF, constant mean, Adam 0.1, 100 steps, float64. scikit-learn: Constant * RBF + White, its default
optimiser, bounds wide enough to hold our optimum. The log marginal likelihood of every result is computed by one
function, ours, summed over the three outputs. `LAPACK` is dpotrf + dpotri on a matrix of that size, as often as our fit
evaluated the likelihood on all points and on its subset: nobody who inverts the matrix can be faster. It is timed with
the library's own threads, one matrix after the other.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import time
import warnings
from pathlib import Path

import gpytorch
import numpy as np
import scipy
import sklearn
import torch
from scipy.linalg import lapack
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel

from implicam.calibrators.every_camera import Scaling
from implicam.calibrators.inverse_gp import UNIFORM_EXTENT_SDS
from implicam.calibrators.inverse_gp_settings import InverseGPSettings
from implicam.calibrators.paper_preset import exact_gp
from implicam.files import write_text
from implicam.gp import Fit, GaussianProcess, Kernel, maximise_each
from implicam.simulate import simulated

GPYTORCH_STEPS = 100  # the steps of its tutorial, twice
SETS = {4: "2R", 8: "2R2W", 12: "2R4W"}


def problem(n, d, seed):
    data = simulated("bar6", points=n, seed=seed, cameras=SETS[d])
    pixels = data.observations.uv.reshape(n, d)
    return Scaling.of(pixels).apply(pixels), Scaling.of(data.xyz).apply(data.xyz)


def ours(X, Y):
    return maximise_each(X, Y, shortest=UNIFORM_EXTENT_SDS)


def with_gpytorch(X, Y):
    return [_gpytorch_one(torch.tensor(X), torch.tensor(np.ascontiguousarray(y))) for y in Y.T]


def _gpytorch_one(X, y):
    likelihood = gpytorch.likelihoods.GaussianLikelihood(
        noise_constraint=gpytorch.constraints.GreaterThan(1e-12)  # its default floor would only make it worse
    ).double()
    model = exact_gp(X, y, likelihood)
    objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    optimiser = torch.optim.Adam(model.parameters(), lr=InverseGPSettings.paper_learning_rate)
    for _ in range(GPYTORCH_STEPS):
        optimiser.zero_grad()
        loss = -objective(model(X), y)
        loss.backward()
        optimiser.step()
    kernel = model.covar_module
    lengthscale = kernel.base_kernel.lengthscale.detach().numpy().ravel()
    found = Kernel("squared-exponential", kernel.outputscale.item(), lengthscale)
    return found, likelihood.noise.item(), model.mean_module.constant.item()


def with_sklearn(X, Y):
    results = []
    for y in Y.T:
        kernel = ConstantKernel(1.0, (1e-5, 1e8)) * RBF(np.ones(X.shape[1]), (1e-2, 1e6)) + WhiteKernel(
            1.0, (1e-12, 10)
        )
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            fit = GaussianProcessRegressor(kernel).fit(X, y)
        k = fit.kernel_
        results.append(
            (Kernel("squared-exponential", k.k1.k1.constant_value, k.k1.k2.length_scale), k.k2.noise_level, 0)
        )
    return results


def likelihood(X, Y, results):
    """Log marginal likelihood, summed over the outputs."""
    total = 0.0
    for y, result in zip(Y.T, results, strict=True):
        kernel, noise, mean = (result.kernel, result.noise_variance, 0.0) if isinstance(result, Fit) else result
        total += GaussianProcess.condition(kernel, noise, X, y, mean).log_marginal_likelihood()
    return total


def lapack_seconds(counts, runs):
    """Seconds for dpotrf + dpotri, `counts` {rows: how often}: the median over runs of one pair, times how often."""
    total = 0.0
    for n, count in counts.items():
        rng = np.random.default_rng(0)
        matrix = np.asfortranarray(np.eye(n) + 0.1 / n * (lambda a: a @ a.T)(rng.normal(size=(n, n))))
        pairs = []
        for _ in range(max(runs, 7)):
            work = matrix.copy(order="F")
            start = time.perf_counter()
            L, _ = lapack.dpotrf(work, lower=1, clean=1, overwrite_a=1)
            lapack.dpotri(L, lower=1, overwrite_c=1)
            pairs.append(time.perf_counter() - start)
        total += count * statistics.median(pairs)
    return total


def timed(work, *arguments):
    start = time.perf_counter()
    result = work(*arguments)
    return result, time.perf_counter() - start


def measure(n, d, runs, slow_runs):
    X, Y = problem(n, d, seed=1)
    methods = {"ours": (ours, runs), "GPyTorch": (with_gpytorch, slow_runs), "scikit-learn": (with_sklearn, slow_runs)}
    seconds, values, counts = {}, {}, {}
    ours(X, Y)  # warm the libraries up
    for name, (work, repeats) in methods.items():
        times = []
        for _ in range(repeats):
            results, elapsed = timed(work, X, Y)
            times.append(elapsed)
        seconds[name], values[name] = statistics.median(times), likelihood(X, Y, results)
        if name == "ours":
            for fit in results:
                for rows, count in fit.evaluations.items():
                    counts[rows] = counts.get(rows, 0) + count
    return {"n": n, "d": d, **seconds, "lml": values, "evaluations": counts, "lapack": lapack_seconds(counts, runs)}


def table(rows, runs, slow_runs):
    lines = [
        f"{platform.machine()}, {torch.get_num_threads()} cores; Python {platform.python_version()}, "
        f"NumPy {np.__version__}, SciPy {scipy.__version__}, GPyTorch {gpytorch.__version__}, "
        f"scikit-learn {sklearn.__version__}. "
        f"Medians of {runs} runs of ours and {slow_runs} of the others.",
        "",
        "| n | d | ours, s | GPyTorch / ours | scikit-learn / ours | ours / LAPACK | log marginal likelihood: ours "
        "| GPyTorch | scikit-learn | evaluations |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        lml = r["lml"]
        evaluations = ", ".join(f"{count} on {n}" for n, count in r["evaluations"].items())
        lines.append(
            f"| {r['n']} | {r['d']} | {r['ours']:.3f} | {r['GPyTorch'] / r['ours']:.1f} "
            f"| {r['scikit-learn'] / r['ours']:.1f} | {r['ours'] / r['lapack']:.2f} | {lml['ours']:.1f} "
            f"| {lml['GPyTorch']:.1f} | {lml['scikit-learn']:.1f} | {evaluations} |"
        )
    return "\n".join(lines) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--slow-runs", type=int, default=3)
    parser.add_argument("--quick", action="store_true", help="n = 157 only, one run of the others")
    parser.add_argument("-o", "--output", type=Path)
    options = parser.parse_args()
    slow_runs = 1 if options.quick else options.slow_runs
    rows = []
    for n in (157,) if options.quick else (157, 792):
        for d in SETS:
            rows.append(measure(n, d, options.runs, slow_runs))
            print(table(rows[-1:], options.runs, slow_runs).splitlines()[-1], flush=True)
    text = table(rows, options.runs, slow_runs)
    print(text)
    if options.output:
        write_text(options.output, text)


if __name__ == "__main__":
    main()
