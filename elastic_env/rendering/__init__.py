"""Pictures in which one sees deviations of milliradians: they are drawn larger, by a factor that
the picture shows.
"""
