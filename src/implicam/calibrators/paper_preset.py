"""The paper's software with its defaults: GPyTorch, positions in metres, Gaussian likelihood with its noise floor.

GPyTorch's `GaussianLikelihood` keeps the noise variance above 1e-4 unless told otherwise. With positions in metres
that is a standard deviation of 10 mm, which is what the paper's table shows (10.2 to 14.9 mm) beside errors of 0.65 mm.
This preset exists to show that; use the standardised fit to measure.

The paper does not state iterations, learning rate or input scaling. Adam with 0.1 is GPyTorch's own tutorial. The
number of steps shows in the paper's table: average standard deviations of 10.2 to 10.5 mm at 3 to 9 boards are those of
a noise that has come down to the floor. On our simulated boards 100 steps leave 12.5 mm, 200 steps 10.4 mm and 400
steps 10.2 mm. Pixels are standardised: with raw pixels the lengthscales cannot move from their start at 0.69 px to
anything useful in so few steps. Precision is float64.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from implicam.errors import import_extra
from implicam.gp import Floats, Kernel
from implicam.progress import Progress

if TYPE_CHECKING:
    from implicam.calibrators.inverse_gp import Hyperparameters, InverseGP
    from implicam.calibrators.inverse_gp_settings import InverseGPSettings


def train(method: InverseGP, X: Floats, Y: Floats, progress: Progress) -> tuple[Hyperparameters, ...]:
    """Hyperparameters of x, y and z after GPyTorch's training.

    The three are one batch of independent GPs: the sum of their losses has the gradients of each, and Adam works
    element by element, so each takes the steps that it would take alone.

    Args:
        method: Its settings have the learning rate and the number of steps.
        X: (n, d) standardised pixels.
        Y: (n, 3) in metres.
        progress: Is told how many steps are done.

    Returns:
        One for each of x, y, z; variances are in squared metres.

    Raises:
        MissingExtraError: PyTorch or GPyTorch is not installed.
    """
    torch = import_extra("torch", "paper", "the paper preset")
    import_extra("gpytorch", "paper", "the paper preset")
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # see implicam.threads: its pool was measured to stall for 20 s beside another process
    try:
        return _train(torch, X, Y, method.settings, progress)
    finally:
        torch.set_num_threads(threads)


def _train(
    torch: Any, X: Floats, Y: Floats, settings: InverseGPSettings, progress: Progress
) -> tuple[Hyperparameters, ...]:
    import gpytorch

    from implicam.calibrators.inverse_gp import Hyperparameters

    outputs = torch.tensor(Y.T.copy())
    inputs = torch.tensor(X).expand(len(outputs), *X.shape)
    likelihood = gpytorch.likelihoods.GaussianLikelihood(batch_shape=outputs.shape[:1]).double()
    model = exact_gp(inputs, outputs, likelihood)
    objective = gpytorch.mlls.ExactMarginalLogLikelihood(likelihood, model)
    optimiser = torch.optim.Adam(model.parameters(), lr=settings.paper_learning_rate)
    model.train()
    likelihood.train()
    steps = settings.paper_training_steps
    for step in range(steps):
        optimiser.zero_grad()
        loss = -objective(model(inputs), outputs).sum()
        loss.backward()
        optimiser.step()
        progress("training", step + 1, steps)
    signal, lengthscale, noise, mean = (
        value.detach().numpy().reshape(len(outputs), -1)
        for value in (
            model.covar_module.outputscale,
            model.covar_module.base_kernel.lengthscale,
            likelihood.noise,
            model.mean_module.constant,
        )
    )
    return tuple(
        Hyperparameters(
            Kernel("squared-exponential", float(signal[i, 0]), lengthscale[i].copy()),
            float(noise[i, 0]),
            float(mean[i, 0]),
        )
        for i in range(len(outputs))
    )


def exact_gp(inputs: Any, outputs: Any, likelihood: Any) -> Any:
    """GPyTorch's tutorial model: constant mean, scaled ARD squared-exponential kernel.

    Args:
        inputs: (n, d), or a batch of such.
        outputs: (n,), or a batch of such.
        likelihood: GPyTorch's, of as large a batch.

    Returns:
        The model, in float64.
    """
    import gpytorch

    batch = {"batch_shape": outputs.shape[:-1]}

    class ExactGP(gpytorch.models.ExactGP):  # type: ignore[misc]
        def __init__(self) -> None:
            super().__init__(inputs, outputs, likelihood)
            self.mean_module = gpytorch.means.ConstantMean(**batch)
            part = gpytorch.kernels.RBFKernel(ard_num_dims=inputs.shape[-1], **batch)
            self.covar_module = gpytorch.kernels.ScaleKernel(part, **batch)

        def forward(self, x: Any) -> Any:
            return gpytorch.distributions.MultivariateNormal(self.mean_module(x), self.covar_module(x))

    return ExactGP().double()
