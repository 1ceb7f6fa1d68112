"""The paper's software with its defaults: GPyTorch, positions in metres, Gaussian likelihood with its noise floor.

GPyTorch's `GaussianLikelihood` keeps the noise variance above 1e-4 unless told otherwise. With positions in metres
that is a standard deviation of 10 mm, which is what the paper's table shows (10.2 to 14.9 mm) beside errors of 0.65 mm.
This preset exists to show that; use the standardised fit to measure.

The paper does not state iterations, learning rate or input scaling. We take the values of GPyTorch's own tutorial
(Adam, 0.1) with 100 steps, and standardised pixels: with raw pixels 100 steps cannot move the lengthscale from its
start at 0.69 px to anything useful. Precision is float64.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from implicam.errors import import_extra
from implicam.gp import Floats, Kernel
from implicam.progress import Progress

if TYPE_CHECKING:
    from implicam.calibrators.inverse_gp import Hyperparameters, InverseGP

STEPS, LEARNING_RATE = 100, 0.1


def train(method: InverseGP, X: Floats, Y: Floats, progress: Progress) -> tuple[Hyperparameters, ...]:
    """Hyperparameters of x, y and z after GPyTorch's training; X standardised pixels, Y in metres."""
    torch = import_extra("torch", "paper", "the paper preset")
    import_extra("gpytorch", "paper", "the paper preset")
    outputs = []
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # see implicam.threads: its pool was measured to stall for 20 s beside another process
    try:
        for i, y in enumerate(Y.T):
            outputs.append(train_one(X, y, lambda step, i=i: progress("training", i * STEPS + step, 3 * STEPS)))
    finally:
        torch.set_num_threads(threads)
    return tuple(outputs)


def train_one(X: Floats, y: Floats, step_done: Any = lambda step: None) -> Hyperparameters:
    """Train one exact GP with GPyTorch's defaults."""
    import gpytorch
    import torch

    from implicam.calibrators.inverse_gp import Hyperparameters

    inputs, outputs = torch.tensor(X), torch.tensor(y)
    likelihood = gpytorch.likelihoods.GaussianLikelihood().double()
    model = exact_gp(inputs, outputs, likelihood)
    objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    optimiser = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE)
    model.train()
    likelihood.train()
    for step in range(STEPS):
        optimiser.zero_grad()
        loss = -objective(model(inputs), outputs)
        loss.backward()
        optimiser.step()
        step_done(step + 1)
    kernel = model.covar_module
    lengthscale = kernel.base_kernel.lengthscale.detach().numpy().ravel()
    return Hyperparameters(
        Kernel("squared-exponential", kernel.outputscale.item(), lengthscale),
        likelihood.noise.item(),
        model.mean_module.constant.item(),
    )


def exact_gp(inputs: Any, outputs: Any, likelihood: Any) -> Any:
    """GPyTorch's tutorial model: constant mean, scaled ARD squared-exponential kernel."""
    import gpytorch

    class ExactGP(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(inputs, outputs, likelihood)
            self.mean_module = gpytorch.means.ConstantMean()
            part = gpytorch.kernels.RBFKernel(ard_num_dims=inputs.shape[1])
            self.covar_module = gpytorch.kernels.ScaleKernel(part)

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    return ExactGP().double()
