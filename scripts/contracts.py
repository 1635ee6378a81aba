"""A kind of contract for `lint-imports`: private modules stay in their package."""

import grimp
from importlinter import Contract, ContractCheck, fields, output


class PrivateContract(Contract):
    """No package imports a private module of another, but of those of `ground`."""

    type_name = "private"

    ground = fields.ListField(subfield=fields.StringField())

    def check(self, graph: grimp.ImportGraph, verbose: bool) -> ContractCheck:
        ground: list[str] = list(self.ground)  # pyright: ignore[reportArgumentType]
        illegal = [
            (importer, imported)
            for importer in sorted(graph.modules)
            for imported in sorted(graph.find_modules_directly_imported_by(importer))
            if _is_private(importer.split("."), imported.split("."), ground)
        ]
        return ContractCheck(kept=not illegal, metadata={"illegal": illegal})

    def render_broken_contract(self, check: ContractCheck) -> None:
        for importer, imported in check.metadata["illegal"]:
            output.print_error(f"{importer} imports {imported}, which is private.")


def _is_private(importer: list[str], imported: list[str], ground: list[str]) -> bool:
    """Whether an import reaches into another package of the library."""
    root, *rest = imported
    if root != importer[0] or not rest or rest[0] in (*ground, *importer[1:2]):
        return False
    return any(name.startswith("_") for name in rest[1:])
