#!/usr/bin/env python3
"""One Gauss-Newton step of refinement by Ceres, beside Relief's own on the same sums of squares.

    ceres.py INPUTS [--threads N]        (needs pyceres, numpy)

INPUTS is the folder that the example `peer_inputs` writes. Every facet is one residual block, all its views put together as Relief
does it, every edge, patch and vertex of the priors another one: this gives Ceres the compression for nothing. It solves by its sparse
normal Cholesky. Its evaluation of residuals runs through Python here and says nothing: compared are its linear solver's own seconds
with those of Relief's factorisation and solution, and the steps."""
import argparse
import json
import pathlib
import time

import numpy as np
import pyceres


class Linear(pyceres.CostFunction):
    """|A x + b|² in scalar unknowns."""

    def __init__(self, matrix, offset):
        super().__init__()
        self.matrix, self.offset = matrix, offset
        self.set_num_residuals(len(offset))
        self.set_parameter_block_sizes([1] * matrix.shape[1])

    def Evaluate(self, parameters, residuals, jacobians):  # noqa: N802, the library's name
        residuals[:] = self.matrix @ [p[0] for p in parameters] + self.offset
        if jacobians is not None:
            for column, jacobian in enumerate(jacobians):
                if jacobian is not None:
                    jacobian[:] = self.matrix[:, column]
        return True


def square_root(hessian, gradient):
    """A and b with AᵀA the Hessian and Aᵀb the gradient."""
    values, vectors = np.linalg.eigh(hessian)
    kept = values > 1e-12 * values[-1]
    matrix = np.sqrt(values[kept])[:, None] * vectors[:, kept].T
    return matrix, (vectors[:, kept].T @ gradient) / np.sqrt(values[kept])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("inputs", type=pathlib.Path)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    solved = json.loads((args.inputs / "step.json").read_text())
    terms = solved["problem"]
    total = np.array(terms["total_m"])
    n_vertices = terms["n_vertices"]
    unknowns = [np.zeros(1) for _ in range(n_vertices + terms["n_groups"])]
    problem = pyceres.Problem()
    # Ceres holds neither functions nor arrays.
    functions = []

    def add(matrix, offset, of):
        functions.append(Linear(np.ascontiguousarray(matrix), np.atleast_1d(offset)))
        problem.add_residual_block(functions[-1], None, [unknowns[i] for i in of])

    for face in terms["faces"]:
        hessian = np.array(face["hessian"])
        if hessian.any():
            add(*square_root(hessian, np.array(face["gradient"])), face["unknowns"])
    root = np.sqrt(terms["rest"])
    for vertex in range(n_vertices):
        add(np.array([[root]]), root * total[vertex], [vertex])
    root = np.sqrt(terms["smoothness"])
    for i, j in terms["edges"]:
        add(np.array([[root, -root]]), root * (total[i] - total[j]), [i, j])
    for patch in terms["patches"]:
        root = np.sqrt(terms["anchor"]) / len(patch)
        add(np.full((1, len(patch)), root), root * total[patch].sum(), patch)

    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.SPARSE_NORMAL_CHOLESKY
    options.num_threads = args.threads
    options.max_num_iterations = 1
    # Next to no damping: a Gauss-Newton step. Columns are scaled, as by default.
    options.initial_trust_region_radius = 1e16
    options.max_trust_region_radius = 1e20
    summary = pyceres.SolverSummary()
    start = time.process_time()
    pyceres.solve(options, problem, summary)
    whole = time.process_time() - start
    share = min(1.0, whole / summary.total_time_in_seconds) if args.threads == 1 else 1.0
    theirs = np.array([unknown[0] for unknown in unknowns[:n_vertices]])
    ours = np.array(solved["step"]["displacement"])
    print(f"{n_vertices} vertices, {len(terms['faces'])} facets seen, {len(functions)} residual blocks, "
          f"{summary.sparse_linear_algebra_library_type}")
    linear = summary.linear_solver_time_in_seconds
    print(f"Ceres: linear solver {linear:.2f} s wall, {share * linear:.2f} s processor by the whole run's share of it, preprocessing "
          f"{summary.preprocessor_time_in_seconds:.2f} s wall, whole {whole:.2f} s processor with evaluation through Python")
    print(f"Relief: factorise and solve {solved['solve_cpu_secs']:.2f} s processor, all residuals of all views with derivatives "
          f"{solved['linearise_cpu_secs']:.2f} s")
    print(f"largest step {np.abs(ours).max():.3e} m, largest difference {np.abs(ours - theirs).max():.3e} m")


if __name__ == "__main__":
    main()
