"""``escape keys``: who may reach a server from another machine."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.context import command_context

app = typer.Typer(
    no_args_is_help=True, help="Keys for servers and clients on different machines (escape serve --bind)."
)
#: A key may begin with a minus sign.
_ANY = {"ignore_unknown_options": True}
Name = Annotated[str, typer.Argument(help="What to call it.")]
Key = Annotated[str, typer.Argument(help="Its public key, 40 characters.")]


def _document(**content: Any) -> dict[str, Any]:
    from escape_hw.io.documents import header_fields

    return {**header_fields("keys", None, None, None), **content}


@app.command("make")
def make(
    replace: Annotated[
        bool, typer.Option("--replace", help="Make new ones; the old ones open nothing.")
    ] = False,
    json: options.Json = False,
) -> None:
    """Make your keys, and tell the public one."""
    with command_context("keys", json=json) as context:
        from escape_hw.remote.keys import keys_folder, make_keys

        public = make_keys(replace).public.decode()
        context.result(_document(public=public, folder=str(keys_folder())))
        context.show(f"public key: {public}", f"(in {keys_folder()}; the secret one never leaves it)")
        # Keys hold characters that mean something to a shell, but never a single quote.
        context.show(
            f"at a server that shall let you in: escape keys allow NAME '{public}'",
            f"at a client of your server: escape keys trust HOST '{public}'",
        )


@app.command("list")
def list_keys(json: options.Json = False) -> None:
    """Your public key, the clients that you let in, the servers that you trust."""
    with command_context("keys", json=json) as context:
        from escape_hw.remote.keys import allowed_keys, own_keys, trusted_keys

        own = own_keys()
        known = {
            "public": None if own is None else own.public.decode(),
            "allowed": {name: key.decode() for name, key in allowed_keys().items()},
            "servers": {name: key.decode() for name, key in trusted_keys().items()},
        }
        context.result(_document(**known))
        context.show(f"public key: {known['public'] or 'none; make one with escape keys make'}")
        context.show(*(f"allowed: {name} {key.decode()}" for name, key in allowed_keys().items()))
        context.show(*(f"server: {name} {key.decode()}" for name, key in trusted_keys().items()))


@app.command("allow", context_settings=_ANY)
def allow(name: Name, key: Key, json: options.Json = False) -> None:
    """Let a client in to your servers; counts at once."""
    with command_context("keys", json=json) as context:
        from escape_hw.remote import keys

        keys.allow(name, key)
        context.result(_document(allowed=name))
        context.show(f"{name} is let in")


@app.command("trust", context_settings=_ANY)
def trust(host: Name, key: Key, json: options.Json = False) -> None:
    """Take the server on a host for the right one when it has this key."""
    with command_context("keys", json=json) as context:
        from escape_hw.remote import keys

        keys.trust(host, key)
        context.result(_document(trusted=host))
        context.show(f"the server on {host} is trusted")


@app.command("forget")
def forget(name: Name, json: options.Json = False) -> None:
    """Let a client in no longer, trust a server no longer."""
    with command_context("keys", json=json) as context:
        from escape_hw.errors import ConfigError
        from escape_hw.remote import keys

        if not keys.forget(name):
            raise ConfigError(f"'{name}' is neither a client that is let in nor a server that is trusted")
        context.result(_document(forgotten=name))
        context.show(f"{name} is forgotten")
