"""The product, stage by stage: objects in, objects out; nothing is printed, and no folder is written unless it is asked for."""
