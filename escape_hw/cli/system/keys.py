"""``escape keys``: keys for connections between computers."""

from __future__ import annotations

from typing import Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import ConfigError

app = typer.Typer(
    no_args_is_help=True, help="Keys for servers and clients on different computers (escape serve --bind)."
)
#: A key may begin with a minus sign.
_ANY = {"ignore_unknown_options": True}
Name = Annotated[str, typer.Argument(help="Name of the client or server.")]
Key = Annotated[str, typer.Argument(help="Its public key, 40 characters.")]


@app.command("make")
@command("keys")
def make(
    context: CommandContext,
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace existing keys, which become invalid.")
    ] = False,
) -> None:
    """Create your key pair and print the public key."""
    from escape_hw.remote.keys import keys_folder, make_keys

    public = make_keys(replace).public.decode()
    context.report(public=public, folder=str(keys_folder()))
    context.show(f"public key: {public}", f"(in {keys_folder()}; the secret key stays there)")
    # Keys contain shell metacharacters, but no single quote.
    context.show(
        f"on the server that you connect to: escape keys allow NAME '{public}'",
        f"on clients of your server: escape keys trust HOST '{public}'",
    )


@app.command("list")
@command("keys")
def list_keys(context: CommandContext) -> None:
    """List your public key, the allowed clients and the trusted servers."""
    from escape_hw.remote.keys import allowed_keys, own_keys, trusted_keys

    own = own_keys()
    public = None if own is None else own.public.decode()
    allowed = {name: key.decode() for name, key in allowed_keys().items()}
    servers = {name: key.decode() for name, key in trusted_keys().items()}
    context.report(public=public, allowed=allowed, servers=servers)
    context.show(f"public key: {public or 'none; make one with escape keys make'}")
    context.show(*(f"allowed: {name} {key}" for name, key in allowed.items()))
    context.show(*(f"server: {name} {key}" for name, key in servers.items()))


@app.command("allow", context_settings=_ANY)
@command("keys")
def allow(context: CommandContext, name: Name, key: Key) -> None:
    """Allow a client to connect to your servers, at once."""
    from escape_hw.remote import keys

    keys.allow(name, key)
    context.report(allowed=name)
    context.show(f"{name} is allowed")


@app.command("trust", context_settings=_ANY)
@command("keys")
def trust(context: CommandContext, host: Name, key: Key) -> None:
    """Trust the server on a host if it has this key."""
    from escape_hw.remote import keys

    keys.trust(host, key)
    context.report(trusted=host)
    context.show(f"the server on {host} is trusted")


@app.command("remove")
@command("keys")
def remove(context: CommandContext, name: Name) -> None:
    """Remove an allowed client or a trusted server."""
    from escape_hw.remote import keys

    if not keys.remove(name):
        raise ConfigError(f"'{name}' is neither an allowed client nor a trusted server")
    # "forgotten" is the key of version 0.1.0.
    context.report(removed=name, forgotten=name)
    context.show(f"{name} is removed")


@app.command("forget", hidden=True)
def forget(name: Name, json: options.Json = False) -> None:
    """Deprecated name of ``remove``."""
    typer.echo("escape keys forget is now called escape keys remove", err=True)
    remove(name=name, json=json)
