"""Exporters of a model file: ONNX (float and QDQ), C header, RTL memories. ``docs/export.md`` says what each is for.

Everything starts from a ``Source``, the bytes of one ``.ubm`` file, so that no exporter has weights of its own. ONNX
needs the packages of the extra ``export``; they are imported where they are used.
"""

from .source import ExportError, MissingPackageError, NetworkName, Source

__all__ = ["ExportError", "MissingPackageError", "NetworkName", "Source"]
