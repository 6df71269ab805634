"""Pictures that enlarge deviations of milliradians, by a factor that they show."""
