"""``escape keys``: keys for connections between computers."""

from __future__ import annotations

from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.context import command_context

app = typer.Typer(
    no_args_is_help=True, help="Keys for servers and clients on different computers (escape serve --bind)."
)
#: A key may begin with a minus sign.
_ANY = {"ignore_unknown_options": True}
Name = Annotated[str, typer.Argument(help="Name of the client or server.")]
Key = Annotated[str, typer.Argument(help="Its public key, 40 characters.")]


def _document(**content: Any) -> dict[str, Any]:
    from escape_hw.io.documents import header_fields

    return {**header_fields("keys", None, None, None), **content}


@app.command("make")
def make(
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace existing keys, which become invalid.")
    ] = False,
    json: options.Json = False,
) -> None:
    """Create your key pair and print the public key."""
    with command_context("keys", json=json) as context:
        from escape_hw.remote.keys import keys_folder, make_keys

        public = make_keys(replace).public.decode()
        context.result(_document(public=public, folder=str(keys_folder())))
        context.show(f"public key: {public}", f"(in {keys_folder()}; the secret key stays there)")
        # Keys contain shell metacharacters, but no single quote.
        context.show(
            f"on the server that you connect to: escape keys allow NAME '{public}'",
            f"on clients of your server: escape keys trust HOST '{public}'",
        )


@app.command("list")
def list_keys(json: options.Json = False) -> None:
    """List your public key, the allowed clients and the trusted servers."""
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
    """Allow a client to connect to your servers, at once."""
    with command_context("keys", json=json) as context:
        from escape_hw.remote import keys

        keys.allow(name, key)
        context.result(_document(allowed=name))
        context.show(f"{name} is allowed")


@app.command("trust", context_settings=_ANY)
def trust(host: Name, key: Key, json: options.Json = False) -> None:
    """Trust the server on a host if it has this key."""
    with command_context("keys", json=json) as context:
        from escape_hw.remote import keys

        keys.trust(host, key)
        context.result(_document(trusted=host))
        context.show(f"the server on {host} is trusted")


@app.command("remove")
def remove(name: Name, json: options.Json = False) -> None:
    """Remove an allowed client or a trusted server."""
    with command_context("keys", json=json) as context:
        from escape_hw.errors import ConfigError
        from escape_hw.remote import keys

        if not keys.remove(name):
            raise ConfigError(f"'{name}' is neither an allowed client nor a trusted server")
        # "forgotten" is the key of version 0.1.0.
        context.result(_document(removed=name, forgotten=name))
        context.show(f"{name} is removed")


@app.command("forget", hidden=True)
def forget(name: Name, json: options.Json = False) -> None:
    """Deprecated name of ``remove``."""
    typer.echo("escape keys forget is now called escape keys remove", err=True)
    remove(name, json)
