"""What several drivers share: loading of vendor libraries, parsing of options, base class and limits of cameras."""
