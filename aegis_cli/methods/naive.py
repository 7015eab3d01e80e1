"""Plain fine-tuning: the expert's gradient goes into the backbone as it is."""

from aegis_cli.methods.base import Method, train_all

METHOD = Method("naive", "plain fine-tuning of backbone and expert", train_all)
