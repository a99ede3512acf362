"""Scores of meshes against the truth by a session's scoring script, for scripts that score."""
import importlib.util


def scoring_script(path):
    """The script as a module, which needs numpy, scipy and open3d."""
    spec = importlib.util.spec_from_file_location("score", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
