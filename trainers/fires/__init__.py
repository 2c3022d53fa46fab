"""Commands on fires: draws a fire, writes fires to a file, joins files of fires."""
