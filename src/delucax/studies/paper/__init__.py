"""The studies of the Deluca paper."""

from ._reproduce import reproduce as reproduce, STUDIES as STUDIES
