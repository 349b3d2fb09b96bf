"""Tables of SRIM among the shared data, by what the package calls the materials."""

TABLES = {
    "Al": "Al",
    "Fe": "Fe",
    "Mylar": "Mylar",
    "polyester": "Polyester_Substrate",
    "EBT active": "EBT2_Active_Layer",
    "HD active": "HDV2_Active_Layer",
}
