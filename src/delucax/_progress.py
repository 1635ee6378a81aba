"""Progress bars."""

import warnings


with warnings.catch_warnings():
    # Without ipywidgets, tqdm warns in a notebook, but the text bar still works.
    warnings.simplefilter("ignore")
    from tqdm.auto import tqdm as tqdm
