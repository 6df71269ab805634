"""What every room uses: errors, validated models, text formats, tables of signals, rows of
worlds, compilation.
"""
