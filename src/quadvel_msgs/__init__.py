"""Message and service definitions as data: installed with pip as the package `quadvel_dds.interfaces`."""
