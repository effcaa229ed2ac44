def print_help(command):
    print("help")
