"""Names of the public tables by SRIM, by the package's names of the materials."""

_FILES = {
    "Al": "Al",
    "Fe": "Fe",
    "Mylar": "Mylar",
    "polyester": "Polyester_Substrate",
    "EBT active": "EBT2_Active_Layer",
    "HD active": "HDV2_Active_Layer",
}
TABLES = {name: f"rcf/stopping/SRIM_{file}.txt" for name, file in _FILES.items()}
